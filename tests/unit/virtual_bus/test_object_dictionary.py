"""The dictionary, its data types and its data sheet."""

import io
from typing import Any

import canopen
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.canopen.objects301 import BITS, SIGNED_BITS, DataType
from servobench.virtual_bus.device.communication_objects import export_eds
from servobench.virtual_bus.device.object_dictionary import Access, ObjectDictionary
from servobench.virtual_bus.device.sdo_abort import AbortCode, SdoAbort, decode, encode
from tests.draws import examples_of
from tests.unit.virtual_bus.device_bench import NODE, TARGET, Bench

EXAMPLES = examples_of(100)
INTEGERS = sorted(set(BITS) - {DataType.REAL32, DataType.REAL64, DataType.BOOLEAN})


@given(data=st.data(), data_type=st.sampled_from(INTEGERS))
@EXAMPLES
def test_integers_of_every_length(data: st.DataObject, data_type: DataType) -> None:
    bits, signed = BITS[data_type], data_type in SIGNED_BITS
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    value = data.draw(st.integers(low, high))
    raw = encode(data_type, value)
    assert len(raw) == bits // 8
    assert int.from_bytes(raw, "little") == value % (1 << bits)
    assert decode(data_type, raw) == value


@pytest.mark.parametrize(("length", "code"), [(1, AbortCode.TOO_SHORT), (3, AbortCode.TOO_LONG)])
def test_wrong_length(length: int, code: AbortCode) -> None:
    with pytest.raises(SdoAbort) as abort:
        decode(DataType.UNSIGNED16, bytes(length))
    assert abort.value.code is code


def test_hooks_run_in_order_and_a_refusal_stores_nothing() -> None:
    dictionary, calls = ObjectDictionary(), list[Any]()

    def check(value: int) -> AbortCode | None:
        calls.append(("check", value, variable.value))
        return AbortCode.LOCAL_CONTROL if value == 2 else None

    variable = dictionary.add(0x2000, "x", DataType.UNSIGNED8, check=check)
    variable.on_write = lambda value: calls.append(("written", value, variable.value))
    dictionary.download(0x2000, 0, b"\x01")
    with pytest.raises(SdoAbort) as abort:
        dictionary.download(0x2000, 0, b"\x02")
    assert abort.value.code is AbortCode.LOCAL_CONTROL
    assert calls == [("check", 1, 0), ("written", 1, 1), ("check", 2, 1)]
    assert variable.value == 1


def test_power_on_value_stands_before_the_default() -> None:
    dictionary = ObjectDictionary()
    relative = dictionary.add(0x2000, "x", DataType.UNSIGNED32, default=0x180, node_relative=True)
    stored = dictionary.add(0x2001, "y", DataType.UNSIGNED32, default=1)
    stored.power_on = 5
    dictionary.restore(0x2000, 0x2001, node_id=3)
    assert (relative.value, stored.value) == (0x183, 5)


@pytest.mark.parametrize(
    ("access", "transmit", "receive"),
    [
        (Access.CONST, True, False),
        (Access.READ_ONLY, True, False),
        (Access.WRITE_ONLY, False, True),
        (Access.READ_WRITE, True, True),
        (Access.READ_WRITE_TPDO, True, False),
        (Access.READ_WRITE_RPDO, False, True),
    ],
)
def test_access_decides_the_direction_of_mapping(access: Access, transmit: bool, receive: bool) -> None:
    variable = ObjectDictionary().add(0x2000, "x", DataType.UNSIGNED8, access, mappable=True)
    assert (variable.mappable_in_tpdo, variable.mappable_in_rpdo) == (transmit, receive)


def test_sub_index_0_counts() -> None:
    record = ObjectDictionary().add_record(0x2000, "r")
    record.add(1, "a", DataType.UNSIGNED8)
    record.add(4, "b", DataType.UNSIGNED8)
    assert record.members[0].value == 4
    assert list(record.members) == [0, 1, 4]


def test_data_sheet_says_what_the_dictionary_says() -> None:
    bench = Bench()
    text = io.StringIO(export_eds(bench.device.dictionary))
    text.name = "device.eds"
    read = canopen.import_od(text, NODE)
    assert {entry.index for entry in bench.device.dictionary} == {index for index in read if index >= 0x1000}
    for entry in bench.device.dictionary:
        for subindex, variable in entry.members.items():
            found = read.get_variable(entry.index, subindex)
            assert found is not None, variable
            assert (found.data_type, found.readable, found.writable) == (
                variable.data_type,
                variable.readable,
                variable.writable,
            )
    cob_id, target = read.get_variable(0x1800, 1), read.get_variable(TARGET)
    assert cob_id is not None
    assert cob_id.default == 0x40000180 + NODE
    assert target is not None
    assert target.min == -1000
