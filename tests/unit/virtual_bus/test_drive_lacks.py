"""A simulated drive that does without something: what a master then meets."""

import struct

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import State
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.unit.virtual_bus.servo_bench import ENABLE, ServoBench


def lacking(*lacks: str) -> ServoBench:
    return ServoBench(DriveParameters(lacks=lacks))


def test_an_object_that_is_lacked_is_neither_read_nor_mapped() -> None:
    bench = lacking("1013", "6074")
    for index in (0x1013, 0x6074):
        with pytest.raises(AssertionError):
            bench.read(index, "I")
    assert bench.write(0x1800, "I", 0xC000_0181, 1) is None
    assert bench.write(0x1A00, "B", 0) is None
    for word in (0x1013_0020, 0x6074_0010):
        assert bench.write(0x1A00, "I", word, 1) == AbortCode.NO_OBJECT


def test_the_default_mappings_go_on_without_it() -> None:
    bench = lacking("1013", "6041")
    assert [frame.data for frame in bench.sync()] == [struct.pack("<ih", 0, 0), struct.pack("<i", 0)]
    assert bench.read(0x1A01, "B") == 1
    assert bench.read(0x1A01, "I", 2) == 0


def test_the_drive_works_on_without_what_it_does_not_show() -> None:
    bench = lacking("1013", "6074", "6007", "6085")
    bench.turn(torque_raw=500)
    assert bench.state is State.OPERATION_ENABLED
    assert bench.speed_rad_s > 10.0


def test_a_command_pdo_without_an_event_timer_has_no_deadline() -> None:
    bench = lacking("1400:5")
    assert bench.write(0x1400, "H", 10, 5) == AbortCode.NO_SUBINDEX
    assert bench.read(0x1400, "B") == 2, "highest sub-index"
    assert bench.write(0x1401, "H", 10, 5) is None, "that of RPDO2 is there"
    bench.command(*ENABLE)
    bench.wait_ms(100)
    assert bench.state is State.OPERATION_ENABLED


def test_tpdos_without_events_go_with_the_sync_alone() -> None:
    bench = lacking("tpdo events")
    assert bench.read(0x1802, "B", 2) == 1
    for kind in (254, 255):
        assert bench.write(0x1802, "B", kind, 2) == AbortCode.TOO_HIGH
    assert bench.write(0x1802, "B", 0, 2) is None
    assert bench.write(0x1400, "B", 255, 2) is None, "RPDOs act on arrival all the same"


@pytest.mark.parametrize("lack", ["1018", "5FFF", "1400:9", "events", "0x6074"])
def test_what_cannot_be_lacked_is_refused(lack: str) -> None:
    with pytest.raises(ValueError, match=f"^{lack}$"):
        SimulatedServo(1, LING, DriveParameters(lacks=(lack,)))


def test_an_index_may_be_written_in_small_letters() -> None:
    bench = lacking("60ff")
    assert bench.write(Object.TARGET_VELOCITY, "i", 0) == AbortCode.NO_OBJECT
