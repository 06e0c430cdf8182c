"""Objects of PDOs in words and as JSON, by columns: as :class:`ObjectValue` words each of them."""

import json
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.drivers.canopen.sdo import object_name
from servobench.hil.reviewing.trace.node_objects import NodeObjects
from servobench.hil.reviewing.trace.number_text import Texts, decimals, general, joined, shortest, texts_of
from servobench.hil.reviewing.trace.object_value import ObjectValue
from servobench.hil.reviewing.trace.pdo_book import PdoLayout
from servobench.hil.reviewing.trace.pdo_columns import ObjectColumn, columns_of

_FEW_VALUES: Final = 8
"""So many times as many frames as values, and each value is worded once."""
Clean = Callable[[str], str]
"""Makes a text fit for a terminal, or for a string of JSON."""


def is_whole_numbers(layout: PdoLayout) -> bool:
    """Return True if the mapping is known, and none of its objects is a real number."""
    return layout.objects is not None and not any(field.real for field in layout.objects)


class WordedValue(NamedTuple):
    """An object in all frames of a block."""

    told: ObjectValue
    """In one of them; name and unit are those of all."""
    raw: Texts
    """As JSON has it."""
    si: NDArray[np.float64] | None
    shown: Texts
    words: Texts | None
    """As JSON has them; None: there are none."""


def worded_values(
    layout: PdoLayout, data: NDArray[np.uint8], objects: NodeObjects, clean: Clean
) -> Iterator[WordedValue]:
    """Yield the objects in ``data``: (n, length)."""
    count, length = data.shape
    filled = np.zeros((count, 8), np.uint8)
    filled[:, :length] = data
    for column in columns_of(layout, filled, length):
        yield _value(column, objects, clean)


def _value(column: ObjectColumn, objects: NodeObjects, clean: Clean) -> WordedValue:
    raw = column.raw
    told = objects.number(*column.key, raw[0].item())
    si, unit = objects.in_si(*column.key, raw.astype(np.float64))
    worded = told.hexadecimal or objects.has_words(column.key[0])
    single, which = np.unique(raw, return_inverse=True)
    if worded or single.size * _FEW_VALUES <= raw.size:
        each = [objects.number(*column.key, value) for value in single.tolist()]
        place = pa.array(which.reshape(-1))
        words = texts_of([f', "words": {json.dumps(one.words)}' if one.words else "" for one in each])
        return WordedValue(
            told,
            texts_of([json.dumps(one.as_json()["raw"]) for one in each]).take(place),
            si,
            texts_of([clean(one.shown) for one in each]).take(place),
            words.take(place),
        )
    numbers = decimals(raw)
    shown = numbers if si is None else joined(general(si), clean(f" {unit} ("), numbers, ")")
    return WordedValue(told, numbers, si, shown, None)


def pdo_text(layout: PdoLayout, values: list[WordedValue], length: int, clean: Clean) -> Iterator[Any]:
    """Yield the parts of the text of PDOs of ``length`` bytes."""
    yield clean(f"{layout.name} ")
    each = [[clean(f"{_title(value.told)} = "), value.shown] for value in values]
    yield from between(each, ", ")
    if 8 * length < layout.bits:
        yield f" (it has {8 * length} bits, {layout.bits} are mapped)"


def _title(told: ObjectValue) -> str:
    name = object_name(told.index, told.sub)
    return f"{name} {told.name}" if told.name else name


def json_value(value: WordedValue) -> list[Any]:
    """Return the parts of its JSON object."""
    head = json.dumps({"index": value.told.index, "sub": value.told.sub, "name": value.told.name})[:-1]
    parts: list[Any] = [f'{head}, "raw": ', value.raw]
    if value.si is not None:
        parts += [', "si": ', shortest(value.si), f', "unit": {json.dumps(value.told.unit)}']
    if value.words is not None:
        parts.append(value.words)
    return [*parts, "}"]


def between(parts: list[list[Any]], comma: str) -> Iterator[Any]:
    """Yield the parts of each one, with ``comma`` between two."""
    for place, part in enumerate(parts):
        if place:
            yield comma
        yield from part
