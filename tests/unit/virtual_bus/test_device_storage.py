"""Store and restore parameters, TIME, bus-off (CiA 301, 7.5.2.13..7.5.2.15)."""

from pathlib import Path

import pytest

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.device.parameter_storage import FileStore, MemoryStore
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.device.station import CommunicationLoss
from tests.unit.virtual_bus.device_bench import (
    DEFAULTS,
    LEVEL,
    NODE,
    RATIO,
    RESET_NODE,
    Bench,
    SdoRefused,
    operational,
)

SAVE, LOAD = 0x65766173, 0x64616F6C


def test_stored_parameters_hold_after_a_reset() -> None:
    bench = Bench()
    bench.write(0x1017, 0, 100, 2)
    bench.write(RATIO, 0, 0x3F800000, 4)
    bench.write(0x1010, 1, SAVE, 4)
    bench.write(0x1017, 0, 200, 2)
    bench.nmt(RESET_NODE)
    assert (bench.read(0x1017), bench.read(RATIO)) == (100, 0x3F800000)


def test_what_is_mappable_is_a_parameter_unless_it_says_otherwise() -> None:
    """CiA 301, 7.5.2.13: all parameters."""
    for stored, kept in ((True, 9), (False, 7)):
        bench = Bench()
        bench.application.level.stored = stored
        bench.write(LEVEL, 0, 9, 4)
        bench.write(0x1010, 1, SAVE, 4)
        bench.nmt(RESET_NODE)
        assert bench.read(LEVEL) == kept


def test_groups_are_apart() -> None:
    bench = Bench()
    bench.write(0x1017, 0, 100, 2)
    bench.write(RATIO, 0, 0x3F800000, 4)
    bench.write(0x1010, 4, SAVE, 4)
    bench.nmt(RESET_NODE)
    assert (bench.read(0x1017), bench.read(RATIO)) == (0, 0x3F800000)


def test_restore_acts_at_the_next_reset() -> None:
    bench = Bench()
    bench.write(0x1017, 0, 100, 2)
    bench.write(0x1010, 1, SAVE, 4)
    bench.write(0x1011, 1, LOAD, 4)
    assert bench.read(0x1017) == 100
    bench.nmt(RESET_NODE)
    assert bench.read(0x1017) == 0


def test_restore_outlives_a_power_cycle() -> None:
    store = MemoryStore()
    store.save({(0x1017, 0): b"\x64\x00", (RATIO, 0): bytes(4)})
    bench = Bench()
    bench.device = CanopenDevice(NODE, bench.application.__class__(), DEFAULTS, store)
    bench.device.start(Instant(0))
    bench.write(0x1011, 2, LOAD, 4)
    assert list(store.load()) == [(RATIO, 0)]
    bench.device.start(Instant(0))
    assert bench.read(0x1017) == 0


@pytest.mark.parametrize(("index", "signature"), [(0x1010, LOAD), (0x1011, SAVE), (0x1010, 0), (0x1010, 1)])
def test_other_signatures_are_refused(index: int, signature: int) -> None:
    bench = Bench()
    with pytest.raises(SdoRefused) as error:
        bench.write(index, 1, signature, 4)
    assert error.value.code == AbortCode.NOT_STORED
    assert bench.read(index, 1) == 1


def test_file_outlives_the_device(tmp_path: Path) -> None:
    path = tmp_path / "node5.json"
    for expected in (0, 100):
        bench = Bench()
        bench.device = CanopenDevice(NODE, bench.application.__class__(), DEFAULTS, FileStore(path))
        bench.device.start(Instant(0))
        assert bench.read(0x1017) == expected
        bench.write(0x1017, 0, 100, 2)
        bench.write(0x1010, 2, SAVE, 4)
    assert [entry.name for entry in tmp_path.iterdir()] == ["node5.json"]


def test_file_that_is_something_else_is_bad_input(tmp_path: Path) -> None:
    path = tmp_path / "node5.json"
    path.write_text("[1, 2]")
    with pytest.raises(BadInput, match="stored parameters"):
        FileStore(path).load()


class FullStore(MemoryStore):
    """Memory that takes nothing."""

    def save(self, parameters: dict[tuple[int, int], bytes]) -> None:
        raise OSError(28, f"no space left for {len(parameters)} parameters")


def test_failing_memory_is_a_hardware_error() -> None:
    bench = Bench()
    bench.device = CanopenDevice(NODE, bench.application.__class__(), DEFAULTS, FullStore())
    bench.device.start(Instant(0))
    with pytest.raises(SdoRefused) as error:
        bench.write(0x1010, 1, SAVE, 4)
    assert error.value.code == AbortCode.HARDWARE


@pytest.mark.parametrize("value", [0xC0000100, 0xA0000100, 0x80000701])
def test_time_cob_id_is_checked(value: int) -> None:
    with pytest.raises(SdoRefused) as error:
        Bench().write(0x1012, 0, value, 4)
    assert error.value.code == AbortCode.INVALID_VALUE


def test_bus_off_ends_operational_and_is_told_afterwards() -> None:
    bench = operational()
    bench.device.bus_off(bench.now)
    assert bench.device.state is NmtState.PRE_OPERATIONAL
    assert ("loss", CommunicationLoss.BUS_OFF, 0, 0) in bench.application.calls
    raised, cleared = bench.device.bus_recovered(bench.now)
    assert (raised.data[:2], cleared.data) == (b"\x40\x81", bytes(8))


def test_stored_value_that_no_longer_fits_is_left_alone() -> None:
    store = MemoryStore()
    store.save(
        {
            (0x1017, 0): b"\x01",
            (0x6072, 0): b"\x01\x00",
            (0x1000, 0): bytes(4),
            (0x1006, 0): b"\x09" + bytes(3),
        }
    )
    bench = Bench()
    bench.device = CanopenDevice(NODE, bench.application.__class__(), DEFAULTS, store)
    bench.device.start(Instant(0))
    assert (bench.read(0x1017), bench.read(0x1006)) == (0, 9)
