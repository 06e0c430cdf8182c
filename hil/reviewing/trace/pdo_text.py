"""Objects of PDOs in words and as JSON, by columns: as :class:`ObjectValue` words each of them.

Numbers in words by columns, letter by letter as Python writes each of them.

    micro_seconds(ns)   f"{ns / 1e9:.6f}"
    general(values)     f"{value:.6g}"
    shortest(values)    repr(value)

What a column cannot decide, ties and exponents, Python writes itself.
"""

import json
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.hil.reviewing.trace.node_objects import NodeObjects
from servobench.hil.reviewing.trace.object_value import ObjectValue
from servobench.hil.reviewing.trace.pdo_book import ObjectColumn, PdoLayout, columns_of

Texts = Any
"""(n,) A StringArray of pyarrow, which has no types of its own."""
_HEX: Final = np.frombuffer(b"0123456789abcdef", np.uint8)
_DIGITS: Final = 6
_TIE: Final = 1e-6
"""So near to a tie the product of a value and a power of ten does not tell on which side it lies."""
EXACT_NS: Final = 1 << 53
"""Up to here an instant is a double as it is."""


def texts_of(values: list[str]) -> Texts:
    """Return strings as a column."""
    return pa.array(values, pa.string())


def decimals(values: NDArray[Any]) -> Texts:
    """Return (n,) whole numbers."""
    return pa.array(values).cast(pa.string())


def micro_seconds(ns: NDArray[np.int64]) -> Texts:
    """Return (n,) times, less than EXACT_NS, in seconds with six digits."""
    us, rest = np.divmod(np.abs(ns), NS_PER_US)
    us += rest > NS_PER_US // 2
    seconds, part = np.divmod(us, NS_PER_S // NS_PER_US)
    padded = pc.utf8_slice_codeunits(decimals(part + 1_000_000), 1)
    told = pc.binary_join_element_wise(_signs(ns < 0), decimals(seconds), ".", padded, "")
    return _mended(told, rest == NS_PER_US // 2, lambda place: f"{int(ns[place]) / 1e9:.6f}")


def general(values: NDArray[np.float64]) -> Texts:
    """Return (n,) values with six significant digits."""
    size = np.abs(values)
    with np.errstate(all="ignore"):
        exponent = np.floor(np.log10(size))
        plain = (exponent >= -4) & (exponent < _DIGITS)
        exponent = np.where(plain, exponent, 0.0)
        scaled = np.where(plain, size, 1.0) * 10.0 ** (_DIGITS - 1 - exponent)
        digits = np.rint(scaled)
        doubtful = ~plain | (np.abs(scaled - np.floor(scaled) - 0.5) < _TIE)
    doubtful |= (digits < 10 ** (_DIGITS - 1)) | (digits >= 10**_DIGITS)
    digits[doubtful] = 10 ** (_DIGITS - 1)
    whole_digits, places = digits.astype(np.int64), (_DIGITS - 1 - exponent).astype(np.int64)
    scale = 10**places
    whole, part = np.divmod(whole_digits, scale)
    padded = pc.utf8_slice_codeunits(decimals(part + scale), 1)
    behind = pc.utf8_rtrim(pc.binary_join_element_wise(".", padded, ""), "0")
    told = pc.binary_join_element_wise(
        _signs(np.signbit(values)), decimals(whole), pc.utf8_rtrim(behind, "."), ""
    )
    return _mended(told, doubtful, lambda place: f"{values[place]:.6g}")


def shortest(values: NDArray[np.float64]) -> Texts:
    """Return (n,) values with as few digits as tell them apart."""
    size = np.abs(values)
    with np.errstate(all="ignore"):
        plain = (size >= 1e-3) & (size < 1e9) & (values != np.rint(values))
    return _mended(pa.array(values).cast(pa.string()), ~plain, lambda place: repr(float(values[place])))


def hexadecimal(data: NDArray[np.uint8]) -> Texts:
    """Return (n,) lower-case texts of ``data``: (n, m)."""
    count, length = data.shape
    letters = _HEX[np.stack((data >> 4, data & 15), 2)].tobytes()
    begins = np.arange(count + 1, dtype=np.int32) * (2 * length)
    return pa.Array.from_buffers(pa.string(), count, [None, pa.py_buffer(begins), pa.py_buffer(letters)])


def joined(*parts: Any) -> Texts:
    """Return the texts one behind the other; a string is the same in each."""
    return pc.binary_join_element_wise(*parts, "")


def _signs(negative: NDArray[np.bool_]) -> Texts:
    return texts_of(["", "-"]).take(pa.array(negative.astype(np.int8)))


def _mended(told: Texts, doubtful: NDArray[np.bool_], text: Callable[[int], str]) -> Texts:
    places = np.flatnonzero(doubtful)
    if not places.size:
        return told
    return pc.replace_with_mask(
        told, pa.array(doubtful), texts_of([text(place) for place in places.tolist()])
    )


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
