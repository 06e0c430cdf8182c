"""A PDO's octets and the objects mapped into it, against integers and struct."""

import struct
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.canopen.objects301 import BITS, SIGNED_BITS, DataType
from servobench.virtual_bus.core.native import SIGNED, PdoCodec
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.device.pdo_parameters import Field, compiled
from tests.draws import examples_of

WHOLE = (
    DataType.BOOLEAN,
    DataType.INTEGER8,
    DataType.INTEGER24,
    DataType.INTEGER32,
    DataType.UNSIGNED16,
    DataType.UNSIGNED64,
)


def mapped(*values: tuple[DataType, float]) -> list[Field]:
    """Variables that hold those values."""
    fields = []
    for data_type, value in values:
        variable = Variable(0x2000, 0, "mapped", data_type)
        variable.value = value
        fields.append(Field(variable, BITS[data_type]))
    return fields


@st.composite
def whole_fields(draw: st.DrawFn) -> Sequence[tuple[DataType, int]]:
    """Objects of up to 64 bits in all."""
    chosen: list[tuple[DataType, int]] = []
    for data_type in draw(st.lists(st.sampled_from(WHOLE), max_size=8)):
        bits = BITS[data_type]
        if sum(BITS[kind] for kind, _ in chosen) + bits <= 64:
            low = -(1 << bits - 1) if data_type in SIGNED_BITS else 0
            chosen.append((data_type, draw(st.integers(low, low + (1 << bits) - 1))))
    return chosen


@examples_of(100)
@given(whole_fields())
def test_objects_lie_behind_one_another_the_first_lowest(values: Sequence[tuple[DataType, int]]) -> None:
    """CiA 301, 7.5.2.36."""
    fields = mapped(*values)
    image, shift = 0, 0
    for data_type, value in values:
        image |= (value & (1 << BITS[data_type]) - 1) << shift
        shift += BITS[data_type]
    data = compiled(fields).pack()
    assert data == image.to_bytes((shift + 7) // 8, "little")
    assert list(compiled(fields).unpack(data)) == [value for _, value in values]


@examples_of(100)
@given(st.floats(width=32), st.floats())
def test_reals_are_as_in_struct(narrow: float, wide: float) -> None:
    for code, data_type, value in (("<f", DataType.REAL32, narrow), ("<d", DataType.REAL64, wide)):
        fields = mapped((data_type, value))
        assert compiled(fields).pack() == struct.pack(code, value)
        assert repr(compiled(fields).unpack(struct.pack(code, value))[0]) == repr(value)


@pytest.mark.parametrize(
    ("data_type", "value"),
    [
        (DataType.INTEGER16, 1 << 15),
        (DataType.INTEGER16, -(1 << 15) - 1),
        (DataType.UNSIGNED8, 256),
        (DataType.UNSIGNED8, -1),
        (DataType.REAL32, 1e300),
    ],
)
def test_a_value_without_room_is_refused(data_type: DataType, value: float) -> None:
    with pytest.raises(ValueError, match="bits do not hold"):
        compiled(mapped((data_type, value))).pack()


def test_a_provider_is_asked_in_place_of_the_value() -> None:
    fields = mapped((DataType.UNSIGNED8, 1), (DataType.UNSIGNED8, 2))
    assert fields[0].variable is not None
    fields[0].variable.provider = lambda: 7
    assert compiled([Field(None, 8), *fields]).pack() == bytes([0, 7, 2])


def test_fewer_octets_and_more_than_64_bits_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        compiled(mapped((DataType.INTEGER16, 0))).unpack(b"\0")
    with pytest.raises(ValueError, match="at most 64"):
        PdoCodec([(None, 64, SIGNED), (None, 1, SIGNED)], False)


def test_a_watch_tells_each_change_once() -> None:
    fields = mapped((DataType.UNSIGNED16, 3), (DataType.INTEGER8, -1))
    changed = compiled(fields).changed
    second = fields[1].variable
    assert second is not None
    assert (changed(), changed()) == (True, False)
    second.value = 1
    assert (changed(), changed()) == (True, False)
    values = iter((5, 5, 6))
    second.provider = lambda: next(values)
    watched = compiled(fields).changed
    assert (watched(), watched(), watched()) == (True, False, True)
