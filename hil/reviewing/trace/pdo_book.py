"""Which PDO an identifier stands for, and what its bits are, as the nodes' parameters have it.

PDOs of one identifier as columns: their mapped objects as numbers, by numpy.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.canopen.cob_ids import CAN_ID, EXTENDED, NOT_VALID
from servobench.drivers.canopen.data_types import REAL_BITS, SIGNED_BITS
from servobench.drivers.canopen.objects301 import FIRST_OBJECT, PDO_ENTRIES_MAX
from servobench.drivers.canopen.pdo import PdoDirection, key_of
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
