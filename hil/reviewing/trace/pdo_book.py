"""Which PDO an identifier stands for, and what its bits are, as the nodes' parameters have it.

PDOs of one identifier as columns: their mapped objects as numbers, by numpy.

Objects of PDOs in words and as JSON, by columns: as :class:`ObjectValue` words each of them.

Numbers in words by columns, letter by letter as Python writes each of them.

    micro_seconds(ns)   f"{ns / 1e9:.6f}"
    general(values)     f"{value:.6g}"
    shortest(values)    repr(value)

What a column cannot decide, ties and exponents, Python writes itself.
"""

import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from servobench.drivers.canopen.cob_ids import CAN_ID, EXTENDED, NOT_VALID
from servobench.drivers.canopen.objects301 import (
    FIRST_OBJECT,
    PDO_ENTRIES_MAX,
    REAL_BITS,
    SIGNED_BITS,
    object_name,
)
from servobench.drivers.canopen.pdo import PdoDirection, key_of
from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.hil.reviewing.trace.node_objects import NodeObjects
from servobench.hil.reviewing.trace.object_value import ObjectValue

_PREDEFINED: Final = 4
"""Lower indices are data types: what they map is a gap."""


@dataclass(frozen=True, slots=True)
class MappedField:
    """An object's place in a PDO."""

    index: int
    sub: int
    shift: int
    """First bit."""
    bits: int
    signed: bool
    real: bool


class PdoLayout(NamedTuple):
    """One PDO."""

    node: int
    name: str
    """TPDO1."""
    objects: tuple[MappedField, ...] | None
    """None: nobody has told the mapping."""

    @property
    def bits(self) -> int:
        """That it takes."""
        return 0 if not self.objects else self.objects[-1].shift + self.objects[-1].bits

    def values(self, data: bytes, objects: NodeObjects) -> tuple[ObjectValue, ...]:
        """Return the values in the data; objects that reach beyond the data are left out."""
        word, numbers = int.from_bytes(data, "little"), []
        for one in self.objects or ():
            if one.index >= FIRST_OBJECT and one.shift + one.bits <= 8 * len(data):
                numbers.append(objects.number(one.index, one.sub, _number(word, one)))
        return tuple(numbers)


class PdoBook:
    """The PDOs of the nodes on one bus."""

    def __init__(self) -> None:
        self._layouts: dict[int, PdoLayout] = {}
        self._stale = True
        self.changes = 0
        """How often :meth:`mark_stale` was called."""

    def mark_stale(self) -> None:
        """A PDO parameter was told, or there is a new node."""
        self._stale = True
        self.changes += 1

    def layout(self, can_id: int, nodes: dict[int, NodeObjects]) -> PdoLayout | None:
        """Return the layout for an identifier; None if it is that of no PDO."""
        if self._stale:
            self._layouts, self._stale = _layouts(nodes), False
        known = self._layouts.get(can_id)
        if known is None and 0x180 < can_id < 0x580 and can_id & 0x7F:
            number, receives = divmod((can_id >> 7) - 3, 2)
            known = PdoLayout(can_id & 0x7F, f"{'R' if receives else 'T'}PDO{number + 1}", None)
        return known


def _layouts(nodes: dict[int, NodeObjects]) -> dict[int, PdoLayout]:
    """By identifier. Where one node's TPDO is others' RPDO, it is the TPDO of who sends it."""
    layouts: dict[int, PdoLayout] = {}
    for direction in PdoDirection:
        for node, objects in sorted(nodes.items()):
            for number in objects.pdo_numbers(direction.value):
                can_id = _identifier(objects, direction, number, node)
                if can_id is not None:
                    mapping = _mapping(objects, direction.mapping_base + number - 1)
                    layouts.setdefault(can_id, PdoLayout(node, f"{direction.letter}PDO{number}", mapping))
    return layouts


def _identifier(objects: NodeObjects, direction: PdoDirection, number: int, node: int) -> int | None:
    """None if the PDO is off, or nobody has told."""
    told = objects.held(direction.value + number - 1, 1)
    if told is None:
        return direction.default_cob_id(number, node) if number <= _PREDEFINED else None
    return None if told & (NOT_VALID | EXTENDED) else told & CAN_ID


def _mapping(objects: NodeObjects, index: int) -> tuple[MappedField, ...] | None:
    count = objects.held(index, 0)
    if count is None or not 0 < count <= PDO_ENTRIES_MAX:
        return None
    fields, shift = [], 0
    for sub in range(1, count + 1):
        word = objects.held(index, sub)
        if word is None:
            return None
        (mapped, mapped_sub), bits = key_of(word), word & 0xFF
        data_type = objects.data_type(mapped, mapped_sub)
        signed, real = data_type in SIGNED_BITS, data_type in REAL_BITS
        fields.append(MappedField(mapped, mapped_sub, shift, bits, signed, real))
        shift += bits
    return tuple(fields)


def _number(word: int, one: MappedField) -> int | float:
    number = word >> one.shift & (1 << one.bits) - 1
    if one.real and one.bits in (32, 64):
        form = "<f" if one.bits == 32 else "<d"
        return float(struct.unpack(form, number.to_bytes(one.bits // 8, "little"))[0])
    return number - (1 << one.bits) if one.signed and one.bits and number >> one.bits - 1 else number


Integers = NDArray[np.int64]
_WORD_BITS: Final = 64


class ObjectColumn(NamedTuple):
    """An object in the PDOs of one identifier."""

    key: tuple[int, int]
    """Index and sub-index."""
    raw: NDArray[np.int64 | np.uint64 | np.float64]
    """(n,), as the object's type has it."""


def columns_of(layout: PdoLayout, data: NDArray[np.uint8], length: int) -> Iterator[ObjectColumn]:
    """Yield the objects of ``data``: (n, 8), of which ``length`` bytes came; gaps and what does not fit into
    them are left out."""
    words = np.ascontiguousarray(data).view("<u8").reshape(-1)
    for field in layout.objects or ():
        if field.index >= FIRST_OBJECT and field.shift + field.bits <= 8 * length:
            yield ObjectColumn((field.index, field.sub), _numbers(words, field))


def _numbers(words: NDArray[np.uint64], field: MappedField) -> NDArray[np.int64 | np.uint64 | np.float64]:
    bits = field.bits
    if not bits:
        return np.zeros(words.size, np.int64)
    if bits == _WORD_BITS and field.shift == 0:
        values = words
    else:
        values = words >> np.uint64(field.shift) & np.uint64((1 << bits) - 1)
    if field.real and bits == 32:
        return values.astype(np.uint32).view(np.float32).astype(np.float64)
    if field.real and bits == _WORD_BITS:
        return np.ascontiguousarray(values).view(np.float64)
    if not field.signed:
        return values if bits == _WORD_BITS else values.astype(np.int64)
    lift = np.uint64(_WORD_BITS - bits)
    return (values << lift).view(np.int64) >> np.int64(_WORD_BITS - bits)


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
