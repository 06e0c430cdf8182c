"""Simulated drives that leave their mode, ignore set-points, refuse mappings or repeat an EMCY, by what is on
the bus and what the shaft does."""

import struct
from typing import Any

import pytest

from servobench.drivers.cia402.profile import FOLLOW_BITS, DriveCommand, Mode, State, Status
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.faults.kinds.ignored_commands import IgnoredCommands
from servobench.virtual_bus.faults.kinds.mode_change import ModeChange
from servobench.virtual_bus.faults.kinds.refused_mapping import RefusedMapping
from servobench.virtual_bus.faults.kinds.repeated_emergency import RepeatedEmergency
from servobench.virtual_bus.faults.node_fault import NodeFault
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.servo_bench import ENABLE
from tests.unit.virtual_bus.test_node_faults import FaultyBench

MS = NS_PER_MS


def deaf(**keys: Any) -> IgnoredCommands:
    return IgnoredCommands(at_s=0.01, **keys)


def running(fault: NodeFault | None, mode: Mode = Mode.CYCLIC_SYNCHRONOUS_TORQUE) -> FaultyBench:
    """Enabled in ``mode``, time zero of the plan 10 ms before ``fault`` strikes."""
    bench = FaultyBench(*([] if fault is None else [fault]))
    assert bench.write(0x6060, "b", mode) is None
    bench.command(*ENABLE)
    assert bench.write(0x6040, "H", 0x0F | FOLLOW_BITS.get(mode, 0)) is None
    bench.begin()
    return bench


def test_a_drive_in_another_mode_tells_so_and_behaves_so() -> None:
    bench = running(ModeChange(at_s=0.03, mode="pv", duration_s=0.3))
    bench.rpdo(0x0F, 300)
    bench.pass_ms(29)
    turning = bench.speed_rad_s
    assert turning > 1.0
    assert bench.read(0x6061, "b") == Mode.CYCLIC_SYNCHRONOUS_TORQUE
    bench.pass_ms(5)
    assert bench.read(0x6061, "b") == Mode.PROFILE_VELOCITY
    assert bench.read(0x6060, "b") == Mode.CYCLIC_SYNCHRONOUS_TORQUE
    bench.pass_ms(250)
    assert abs(bench.speed_rad_s) < 0.05 * turning, "60FFh is 0: it brakes, whatever torque is asked for"
    bench.pass_ms(70)
    assert bench.read(0x6061, "b") == Mode.CYCLIC_SYNCHRONOUS_TORQUE
    assert bench.speed_rad_s > 0.3 * turning


def test_a_mode_that_was_written_meanwhile_stays() -> None:
    bench = running(ModeChange(at_s=0.01, mode="pv", duration_s=0.02))
    bench.pass_ms(15)
    assert bench.write(0x6060, "b", Mode.CYCLIC_SYNCHRONOUS_VELOCITY) is None
    assert bench.read(0x6061, "b") == Mode.CYCLIC_SYNCHRONOUS_VELOCITY
    bench.pass_ms(30)
    assert bench.read(0x6061, "b") == Mode.CYCLIC_SYNCHRONOUS_VELOCITY


def test_the_mode_of_6060h_written_again_is_taken() -> None:
    bench = running(ModeChange(at_s=0.01, mode="pv"))
    bench.pass_ms(15)
    assert bench.read(0x6061, "b") == Mode.PROFILE_VELOCITY
    assert bench.write(0x6060, "b", Mode.CYCLIC_SYNCHRONOUS_TORQUE) is None
    assert bench.read(0x6061, "b") == Mode.CYCLIC_SYNCHRONOUS_TORQUE


SET_POINTS: dict[Mode, list[tuple[int, str, int]]] = {
    Mode.PROFILE_VELOCITY: [(0x60FF, "i", 300_000)],
    Mode.PROFILE_TORQUE: [(0x6071, "h", 200)],
    Mode.VELOCITY: [(0x6042, "h", 300)],
    Mode.INTERPOLATED_POSITION: [(0x60C1, "i", 3000)],
    Mode.PROFILE_POSITION: [(0x607A, "i", 100_000), (0x6040, "H", 0x1F)],
    Mode.CYCLIC_SYNCHRONOUS_POSITION: [(0x607A, "i", 3000), (0x60B1, "i", 1000)],
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY: [(0x60FF, "i", 300_000), (0x60B2, "h", 100)],
    Mode.CYCLIC_SYNCHRONOUS_TORQUE: [(0x6071, "h", 200), (0x60B2, "h", 50)],
}

SUBS = {0x60C1: 1}


def give(bench: FaultyBench, mode: Mode, times: int) -> None:
    for index, code, value in SET_POINTS[mode]:
        factor = 1 if index == 0x6040 else times
        assert bench.write(index, code, value * factor, SUBS.get(index, 0)) is None
    if mode is Mode.PROFILE_POSITION:
        assert bench.write(0x6040, "H", 0x0F) is None


def shaft(bench: FaultyBench) -> tuple[int, float]:
    return bench.read(0x6064, "i"), bench.speed_rad_s


@pytest.mark.parametrize("mode", SET_POINTS, ids=lambda mode: mode.title)
def test_the_last_set_points_go_on_to_act_and_the_newest_act_afterwards(mode: Mode) -> None:
    """The shaft against that of a drive that was given no others, then against one that always heard them."""
    bench, twin = running(deaf(duration_s=0.03), mode), running(None, mode)
    for each in (bench, twin):
        give(each, mode, 1)
        each.pass_ms(20)
    assert shaft(bench) == shaft(twin)
    give(bench, mode, 2)
    for _ in range(4):
        for each in (bench, twin):
            each.pass_ms(4)
        assert shaft(bench) == shaft(twin)
        index, code, value = SET_POINTS[mode][0]
        assert bench.read(index, code, SUBS.get(index, 0)) == 2 * value, "the objects show what was written"
    for each in (bench, twin):
        each.pass_ms(5)
    if mode is not Mode.PROFILE_POSITION:  # the rising edge of bit 4 went by
        give(twin, mode, 2)
        for each in (bench, twin):
            each.pass_ms(30)
        assert bench.speed_rad_s == pytest.approx(twin.speed_rad_s, rel=0.05)


@pytest.mark.parametrize("mode", SET_POINTS, ids=lambda mode: mode.title)
def test_without_set_points_nothing_is_asked_of_the_shaft(mode: Mode) -> None:
    bench = running(deaf(holds="zero"), mode)
    bench.pass_ms(15)
    give(bench, mode, 1)
    bench.pass_ms(100)
    assert bench.speed_rad_s == 0.0
    assert bench.read(0x6064, "i") == 0
    assert bench.shows(State.OPERATION_ENABLED)


@pytest.mark.parametrize("cleared", [True, False])
def test_bit_12_tells_of_it_or_not(cleared: bool) -> None:
    bench = running(deaf(duration_s=0.02, bit_12_cleared=cleared))
    assert bench.statusword & Status.FOLLOWS_COMMAND
    bench.pass_ms(15)
    assert bool(bench.statusword & Status.FOLLOWS_COMMAND) is not cleared
    bench.pass_ms(20)
    assert bench.statusword & Status.FOLLOWS_COMMAND


def test_the_state_machine_obeys_and_a_drive_enabled_again_is_as_deaf() -> None:
    bench = running(deaf(holds="zero"))
    bench.pass_ms(15)
    bench.command(DriveCommand.SHUTDOWN)
    assert bench.shows(State.READY)
    bench.command(*ENABLE, torque_raw=300)
    assert bench.shows(State.OPERATION_ENABLED)
    assert not bench.statusword & Status.FOLLOWS_COMMAND
    bench.pass_ms(50)
    assert bench.speed_rad_s == 0.0


def test_a_reset_of_the_node_ends_it() -> None:
    bench = running(deaf(holds="zero"))
    bench.pass_ms(15)
    bench.nmt(0x81)
    bench.pass_ms(100)
    bench.nmt(0x01)
    bench.command(*ENABLE, torque_raw=300)
    bench.pass_ms(20)
    assert bench.speed_rad_s > 1.0
    assert bench.statusword & Status.FOLLOWS_COMMAND


def emergencies(sent: list[tuple[Instant, Frame]]) -> list[tuple[Instant, bytes]]:
    return [(when, frame.data[:3]) for when, frame in sent if frame.can_id == 0x081]


def test_an_emergency_comes_again_and_again_while_the_drive_is_enabled() -> None:
    bench = running(RepeatedEmergency(at_s=0.01, code=0x2310, period_ms=4, duration_s=0.03))
    again = [(Instant(bench.zero + at * MS), b"\x10\x23\x03") for at in range(10, 40, 4)]
    assert emergencies(bench.pass_ms(100)) == again
    assert bench.shows(State.OPERATION_ENABLED)
    assert bench.read(0x603F, "H") == 0x2310
    assert bench.read(0x1001, "B") == 0x03
    bench.sent.clear()
    bench.command(DriveCommand.DISABLE_VOLTAGE)
    assert [frame.data[:3] for frame in bench.sent if frame.can_id == 0x081] == [bytes(3)]


def test_a_drive_that_is_not_enabled_sends_none() -> None:
    bench = FaultyBench(RepeatedEmergency(at_s=0.01, code=0x4310))
    bench.begin()
    assert emergencies(bench.pass_ms(100)) == []
    bench.command(*ENABLE)
    assert len(emergencies(bench.pass_ms(100))) == 10


@pytest.mark.parametrize(
    ("fault", "refused", "taken"),
    [
        (
            {"parameter": "1A00:1"},
            [(0x1A00, 1, 0x60640020)],
            [(0x1A00, 2, 0x60640020), (0x1A01, 1, 0x60640020)],
        ),
        ({"parameter": "1600:0"}, [(0x1600, 0, 0), (0x1600, 0, 1)], [(0x1A00, 1, 0x60640020)]),
        ({"mapped": "606C"}, [(0x1A00, 1, 0x606C0020), (0x1A01, 2, 0x606C0020)], [(0x1A00, 1, 0x60640020)]),
        (
            {"parameter": "1A01:2", "mapped": "606C"},
            [(0x1A01, 2, 0x606C0020)],
            [(0x1A00, 2, 0x606C0020), (0x1A01, 2, 0x60640020)],
        ),
    ],
)
@pytest.mark.parametrize("abort", [None, AbortCode.DEVICE_STATE, 0x0FFF1234])
def test_a_mapping_is_refused_from_power_on(
    fault: dict[str, Any],
    refused: list[tuple[int, int, int]],
    taken: list[tuple[int, int, int]],
    abort: int | None,
) -> None:
    bench = FaultyBench(RefusedMapping(**fault | ({} if abort is None else {"abort": int(abort)})))
    bench.device.start(bench.now)
    for index in (0x1600, 0x1A00, 0x1A01):
        valid = bench.read(index - 0x200, "I", 1)
        assert bench.write(index - 0x200, "I", valid | 1 << 31, 1) is None
        if (index, 0, 0) not in refused:
            assert bench.write(index, "B", 0) is None
    for index, sub, word in refused:
        code = abort or AbortCode.NOT_MAPPABLE
        assert bench.write(index, "I" if sub else "B", word, sub) == code
    for index, sub, word in taken:
        assert bench.write(index, "I", word, sub) is None
    assert struct.pack("<I", bench.read(0x1A00, "I", 1))
