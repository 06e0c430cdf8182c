"""Which PDO an identifier is, and what its bits hold, by the parameters that the nodes have told."""

import math
import struct

import pytest

from servobench.drivers.canopen.objects301 import DataType
from servobench.hil.reviewing.trace.node_objects import NodeObjects
from servobench.hil.reviewing.trace.pdo_book import MappedField, PdoBook, PdoLayout
from tests.unit.hil.test_known_objects import sheet, variable

FIRST = {
    0x180: "TPDO1", 0x200: "RPDO1", 0x280: "TPDO2", 0x300: "RPDO2",
    0x380: "TPDO3", 0x400: "RPDO3", 0x480: "TPDO4", 0x500: "RPDO4",
}  # fmt: skip
"""Of node 0, by CiA 301 table 39."""
STATUSWORD = MappedField(0x6041, 0, 0, 16, signed=False, real=False)
SPEED = MappedField(0x606C, 0, 16, 32, signed=True, real=False)
OFF, NO_RTR, EXTENDED = 1 << 31, 1 << 30, 1 << 29


def node(told: dict[tuple[int, int], int]) -> NodeObjects:
    objects = NodeObjects()
    for key, value in told.items():
        objects.take(*key, value.to_bytes(4, "little"))
    return objects


def mapping(index: int, *words: int) -> dict[tuple[int, int], int]:
    """The objects of a mapping parameter."""
    return {(index, 0): len(words)} | {(index, sub): word for sub, word in enumerate(words, 1)}


def layout(can_id: int, **nodes: dict[tuple[int, int], int]) -> PdoLayout | None:
    """Of an identifier, where ``n3`` is what node 3 has told."""
    return PdoBook().layout(can_id, {int(name[1:]): node(told) for name, told in nodes.items()})


def fields(told: PdoLayout | None) -> tuple[MappedField, ...]:
    assert told is not None
    assert told.objects is not None
    return told.objects


def test_an_identifier_that_nobody_told_of_is_that_of_the_predefined_set() -> None:
    book = PdoBook()
    named = {
        first + number: PdoLayout(number, name, None)
        for first, name in FIRST.items()
        for number in range(1, 128)
    }
    assert {can_id: book.layout(can_id, {}) for can_id in range(0x800)} == {
        can_id: named.get(can_id) for can_id in range(0x800)
    }
    assert PdoLayout(1, "TPDO1", None).bits == 0


def test_a_mapping_is_laid_out_from_the_first_bit_on() -> None:
    told = layout(0x185, n5=mapping(0x1A00, 0x6041_0010, 0x606C_0020))
    assert told == PdoLayout(5, "TPDO1", (STATUSWORD, SPEED))
    assert told is not None
    assert told.bits == 48
    assert layout(0x205, n5=mapping(0x1600, 0x6071_0010)) == PdoLayout(
        5, "RPDO1", (MappedField(0x6071, 0, 0, 16, signed=True, real=False),)
    )
    (high,) = fields(layout(0x185, n5=mapping(0x1A00, 0x2345_6708)))
    assert (high.index, high.sub, high.bits) == (0x2345, 0x67, 8)


def test_a_mapping_that_is_not_told_to_its_end_is_not_known() -> None:
    whole = mapping(0x1A00, 0x6041_0010, 0x606C_0020)
    unknown = PdoLayout(5, "TPDO1", None)
    for key in whole:
        assert layout(0x185, n5={each: word for each, word in whole.items() if each != key}) == unknown
    assert layout(0x185, n5=whole | {(0x1A00, 0): 0}) == unknown
    assert len(fields(layout(0x185, n5=mapping(0x1A00, *[0x6040_0001] * 64)))) == 64
    assert layout(0x185, n5=mapping(0x1A00, *[0x6040_0001] * 65)) == unknown


@pytest.mark.parametrize(
    ("cob_id", "at"),
    [
        (0x185, 0x185), (0x1F3, 0x1F3), (NO_RTR | 0x191, 0x191), (0x6FF, 0x6FF), (0x800 | 0x187, 0x187),
        (OFF | 0x185, None), (EXTENDED | 0x185, None), (OFF | NO_RTR | 0x185, None),
    ],
)  # fmt: skip
def test_a_pdo_is_at_the_identifier_that_its_node_told_or_off(cob_id: int, at: int | None) -> None:
    told = mapping(0x1A00, 0x6041_0010) | {(0x1800, 1): cob_id}
    book = PdoBook()
    nodes = {5: node(told)}
    known = {each: book.layout(each, nodes) for each in range(0x800)}
    mapped = {each for each, one in known.items() if one is not None and one.objects is not None}
    assert mapped == (set() if at is None else {at})


def test_a_fifth_pdo_has_no_identifier_before_it_was_told() -> None:
    fourth = mapping(0x1A03, 0x6041_0010)
    fifth = mapping(0x1A04, 0x606C_0020)
    assert layout(0x485, n5=fourth) == PdoLayout(5, "TPDO4", (STATUSWORD,))
    nodes = {5: node(fifth)}
    book = PdoBook()
    assert all(
        one is None or one.objects is None for one in (book.layout(each, nodes) for each in range(0x800))
    )
    told = layout(0x1A5, n5=fifth | {(0x1804, 1): 0x1A5})
    assert told == PdoLayout(5, "TPDO5", (MappedField(0x606C, 0, 0, 32, signed=True, real=False),))


def test_of_two_with_one_identifier_it_is_the_tpdo_and_of_the_lower_node() -> None:
    sends = mapping(0x1A01, 0x6041_0010) | {(0x1801, 1): 0x333}
    hears = mapping(0x1602, 0x6040_0010) | {(0x1402, 1): 0x333}
    assert layout(0x333, n2=hears, n9=sends) == PdoLayout(9, "TPDO2", (STATUSWORD,))
    assert layout(0x333, n9=sends, n4=sends) == PdoLayout(4, "TPDO2", (STATUSWORD,))
    heard = layout(0x333, n9=hears, n4=hears)
    assert heard is not None
    assert (heard.node, heard.name) == (4, "RPDO3")


def test_the_book_is_made_anew_only_when_it_is_stale() -> None:
    book, nodes = PdoBook(), {5: node({})}
    unknown, known = PdoLayout(5, "TPDO1", None), PdoLayout(5, "TPDO1", (STATUSWORD,))
    assert (book.layout(0x185, nodes), book.changes) == (unknown, 0)
    for key, word in mapping(0x1A00, 0x6041_0010).items():
        nodes[5].take(*key, word.to_bytes(4, "little"))
    assert book.layout(0x185, nodes) == unknown
    book.mark_stale()
    assert (book.layout(0x185, nodes), book.changes) == (known, 1)


def numbers(told: PdoLayout | None, data: bytes, objects: NodeObjects | None = None) -> list[object]:
    assert told is not None
    values = told.values(data, objects or NodeObjects())
    return [(one.index, one.sub, one.raw) for one in values]


def test_fields_that_are_not_all_there_are_left_out() -> None:
    told = layout(0x185, n5=mapping(0x1A00, 0x6041_0010, 0x606C_0020))
    data = struct.pack("<Hi", 0x0237, -2)
    whole = [(0x6041, 0, 0x0237), (0x606C, 0, -2)]
    assert numbers(told, data) == numbers(told, data + b"\xff\xff") == whole
    assert numbers(told, data[:5]) == numbers(told, data[:2]) == whole[:1]
    assert numbers(told, data[:1]) == numbers(told, b"") == []
    assert numbers(PdoLayout(1, "TPDO1", None), data) == []


def test_a_gap_takes_bits_and_has_no_value() -> None:
    """What is mapped below 1000h is a data type: 0005h, an octet that stays empty."""
    told = layout(0x185, n5=mapping(0x1A00, 0x0005_0008, 0x0FFF_0008, 0x1001_0008))
    assert numbers(told, b"\x11\x22\x33") == [(0x1001, 0, 0x33)]


@pytest.mark.parametrize("value", [-(1 << 31), -1, 0, 1, (1 << 31) - 1])
def test_signed_objects_have_their_sign_wherever_they_lie(value: int) -> None:
    """Three bits before them, which are a maker's own and have none."""
    told = layout(0x185, n5=mapping(0x1A00, 0x2000_0003, 0x606C_0020))
    word = 0b111 | (value & 0xFFFF_FFFF) << 3
    assert numbers(told, word.to_bytes(5, "little")) == [(0x2000, 0, 0b111), (0x606C, 0, value)]


def real_layout(kind: DataType, bits: int) -> tuple[PdoLayout, NodeObjects]:
    objects = node(mapping(0x1A00, 0x2000_0000 | bits))
    objects.use_sheet(sheet(variable(0x2000, 0, kind=kind)))
    told = PdoBook().layout(0x185, {5: objects})
    assert told is not None
    return told, objects


@pytest.mark.parametrize(
    ("kind", "form"), [(DataType.REAL32, "<f"), (DataType.REAL64, "<d")], ids=["32 bits", "64 bits"]
)
@pytest.mark.parametrize("value", [1.5, -0.25, math.inf, 0.0])
def test_real_numbers_are_read_in_their_length(kind: DataType, form: str, value: float) -> None:
    data = struct.pack(form, value)
    told, objects = real_layout(kind, 8 * len(data))
    assert fields(told) == (MappedField(0x2000, 0, 0, 8 * len(data), signed=False, real=True),)
    assert numbers(told, data, objects) == [(0x2000, 0, value)]


@pytest.mark.parametrize(("kind", "bits"), [(DataType.REAL32, 24), (DataType.REAL64, 16)])
def test_a_real_number_of_another_length_is_its_bits(kind: DataType, bits: int) -> None:
    told, objects = real_layout(kind, bits)
    assert numbers(told, b"\xff" * 8, objects) == [(0x2000, 0, (1 << bits) - 1)]


def test_a_signed_object_of_no_bits_is_zero() -> None:
    told = layout(0x185, n5=mapping(0x1A00, 0x606C_0000))
    assert numbers(told, b"\xff") == numbers(told, b"") == [(0x606C, 0, 0)]


def test_the_values_of_a_pdo_are_in_the_units_of_its_node() -> None:
    objects = node({(0x6076, 0): 2000})
    told = PdoLayout(5, "TPDO1", (MappedField(0x6077, 0, 8, 16, signed=True, real=False),))
    (value,) = told.values(b"\0" + struct.pack("<h", -500), objects)
    assert (value.raw, value.si, value.unit, value.name) == (-500, -1.0, "N m", "Torque actual value")
