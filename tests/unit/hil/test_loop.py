"""The loop and its axes against a made-up bus."""

import math
from collections.abc import Callable
from itertools import pairwise

import pytest

from servobench.drivers.errors import DriveInFault, LimitExceeded, NoAnswer
from servobench.drivers.exchange import Command, SentCommand, SpeedCommand
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.control.compensation import Stamp
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.loop import Actuation, LoopOutcome
from servobench.hil.loop.pace import CALIBRATION_SYNCS, CALIBRATION_SYNCS_MAX
from servobench.hil.loop.protocol import Controller
from servobench.hil.loop.safety import SpeedLimits, TorqueLimits
from servobench.hil.loop.samples import Dropout, DropoutCause, Sample, StateEstimate
from tests.unit.hil.loop_fakes import (
    DEVICE_CLOCK_OFFSET_NS,
    PERIOD,
    TIMING,
    FakeBus,
    FakeDrive,
    Proportional,
    make_axis,
    make_loop,
    reading_at,
)


def estimate_of(record: CycleRecord) -> StateEstimate:
    assert record.estimate is not None
    return record.estimate


def command_of(record: CycleRecord) -> Command:
    assert record.command is not None
    return record.command


def handed_after(record: CycleRecord) -> int:
    """From the tick until its command was handed over, ns."""
    assert record.sending is not None
    return record.sending.handed_at - record.due_at


def run(
    delay: Callable[[int], int | None],
    cycles: int,
    *,
    oversleep: Callable[[int], int] | None = None,
    stall: Callable[[Instant], Duration] | None = None,
    stamp_delay: int = 0,
    limits: TorqueLimits | None = None,
    stop_after: int | None = None,
    prepare: Callable[[FakeDrive], None] = lambda drive: None,
    controller: Controller | None = None,
) -> tuple[LoopOutcome, list[CycleRecord], FakeDrive]:
    """Calibrate without delay trouble, then run with ``delay(cycle)``, cycles counted from 1."""
    records, drive = list[CycleRecord](), FakeDrive(lambda sequence: 250_000)
    bus = FakeBus([drive])
    compensator = Stamp(Duration(stamp_delay), Duration(PERIOD)) if stamp_delay else None
    actuation = Actuation.ON_SYNC if stamp_delay else Actuation.ON_ARRIVAL
    loop = make_loop(bus, [make_axis(drive, records, compensator, limits, controller)], stall, actuation)
    loop.calibrate()
    drive.delay = lambda sequence: delay(sequence - CALIBRATION_SYNCS)
    bus.oversleep = oversleep
    prepare(drive)
    calls = iter(range(10**9))
    outcome = loop.run(
        Duration(cycles * PERIOD),
        should_stop=lambda: stop_after is not None and next(calls) >= stop_after,
        on_start=lambda at: None,
        progress=lambda done: None,
    )
    return outcome, records, drive


def test_each_cycle_uses_its_own_reading_and_is_recorded_once() -> None:
    outcome, records, drive = run(lambda cycle: 300_000, 40)
    assert outcome.cycles == len(records) == len(drive.commands) == 40
    assert [record.sequence for record in records] == list(range(1, 41))
    for record in records:
        assert isinstance(record.observation, Sample)
        assert estimate_of(record).sequence == record.sequence
        assert record.delay == 300_000
        assert record.observation.sampled_at == record.sync_on_bus_at
    assert command_of(records[9]).torque_nm == 0.0
    assert command_of(records[10]).torque_nm == 2.0


def test_the_command_is_sent_as_soon_as_the_reading_is_there() -> None:
    _, records, _ = run(lambda cycle: 300_000, 10)
    assert {handed_after(record) for record in records} == {350_000}


def test_a_lost_reading_delays_the_command_to_the_latest_moment_and_no_further() -> None:
    _, records, _ = run(lambda cycle: None if cycle == 5 else 300_000, 30)
    lost = records[4]
    assert isinstance(lost.observation, Dropout)
    assert lost.observation.cause is DropoutCause.LOST
    assert lost.delay is None
    assert estimate_of(lost).sequence == records[3].sequence
    assert handed_after(lost) == 700_000
    assert handed_after(records[5]) == 350_000


def test_a_steady_delay_beyond_the_period_is_no_dropout_and_costs_no_waiting() -> None:
    _, records, _ = run(lambda cycle: 1_400_000, 120)
    assert all(isinstance(record.observation, Sample) for record in records)
    for record in records[60:]:
        assert estimate_of(record).sequence == record.sequence - 1
        assert handed_after(record) == 450_000


def test_beyond_the_deadline_a_reading_is_late_and_not_used() -> None:
    _, records, _ = run(lambda cycle: 2_500_000 if cycle == 7 else 300_000, 30)
    assert records[6].observation.cause is DropoutCause.LATE  # type: ignore[union-attr]
    assert records[6].delay == 2_500_000
    assert all(estimate_of(record).sequence != records[6].sequence for record in records)


def test_an_overtaken_reading_is_stale() -> None:
    _, records, _ = run(lambda cycle: 1_700_000 if cycle == 7 else 300_000, 30)
    assert records[6].observation.cause is DropoutCause.STALE  # type: ignore[union-attr]


@pytest.mark.parametrize("certain", [True, False])
def test_a_reading_is_stale_for_certain_only_while_the_places_of_others_are(certain: bool) -> None:
    """One with a stamp far from all SYNCs puts the question whether the clock was set, or which is whose.
    That of cycle 26 puts it too, and the next one answers it: that takes back no doubt from before."""
    drives: list[FakeDrive] = []

    def delay(cycle: int) -> int:
        if cycle == 24 and not certain:
            drives[0].readings.append(reading_at(Instant(0), 0))
        return {20: 1_700_000, 26: 2_900_000}.get(cycle, 300_000)

    _, records, _ = run(delay, 60, prepare=drives.append)
    assert [getattr(records[place].observation, "cause", None) for place in (19, 25)] == [
        DropoutCause.STALE,
        DropoutCause.LATE,
    ]
    uncertain = [record.sequence for record in records if not record.observation.certain]
    assert uncertain == ([] if certain else [20])


def test_stamp_makes_a_varying_delay_constant() -> None:
    delays = [200_000, 900_000, 1_100_000, 450_000]
    _, records, _ = run(lambda cycle: delays[cycle % 4], 80, stamp_delay=2 * NS_PER_MS)
    ages = {command_of(record).effective_at - estimate_of(record).valid_at for record in records[20:]}
    assert ages == {2 * NS_PER_MS}


def test_missed_ticks_are_skipped_counted_and_the_grid_kept() -> None:
    outcome, records, _ = run(
        lambda cycle: 300_000, 40, oversleep=lambda count: 3_200_000 if count == CALIBRATION_SYNCS + 9 else 0
    )
    assert (outcome.cycles, outcome.cycles_missed) == (40, 3)
    assert [record.sequence for record in records] == list(range(1, 41))
    first = records[0].due_at
    assert [record.due_at - first for record in records] == [number * PERIOD for number in range(40)]
    causes = {
        record.sequence: record.observation.cause
        for record in records
        if isinstance(record.observation, Dropout)
    }
    assert causes == dict.fromkeys((10, 11, 12), DropoutCause.MISSED)
    missed = records[10]
    assert (missed.woke_at, missed.sync_handed_at, missed.sync_on_bus_at, missed.command) == (None,) * 4


def test_a_controller_is_told_of_all_cycles_without_reading_missed_ones_too() -> None:
    controller, lost, late = Proportional(), {10: None, 11: None}, CALIBRATION_SYNCS + 9
    run(lambda n: lost.get(n, n), 20, oversleep=lambda n: 3_200_000 * (n == late), controller=controller)
    assert controller.dropouts == [*[0] * 9, 4, 5, *[0] * 6], "three are missed after the ninth"


@pytest.mark.parametrize("first", [1, 2, 9, 13])
@pytest.mark.parametrize("stood_still", [1, 3, 20])
def test_a_drive_that_stood_still_while_calibrating_has_taught_nothing_wrong(
    first: int, stood_still: int
) -> None:
    """It answers the SYNCs of that time all at once, beside the next one."""
    settle, last = TIMING.settle, first + stood_still

    def delay(sync: int) -> int:
        return 250_000 + (last - sync) * settle if first <= sync < last else 250_000

    drive = FakeDrive(delay)
    axis = make_axis(drive, [])
    make_loop(FakeBus([drive]), [axis]).calibrate()
    clock = axis.by_stamp.clock
    assert clock.offset_ns == -DEVICE_CLOCK_OFFSET_NS
    assert abs(clock.drift_ppm) < 1e-3
    assert len(axis.lessons) >= CALIBRATION_SYNCS // 2


def test_a_drive_that_never_answers_in_time_is_not_asked_for_ever() -> None:
    drive = FakeDrive(lambda sync: 250_000 if sync % 2 else 250_000 + TIMING.settle)
    axis = make_axis(drive, [])
    bus = FakeBus([drive])
    make_loop(bus, [axis]).calibrate()
    assert (bus.sync_count, len(axis.lessons)) == (CALIBRATION_SYNCS_MAX, 1)


@pytest.mark.parametrize("stopped_in", [10, 40])
def test_a_sync_handed_over_ticks_too_late_is_that_of_the_tick_it_falls_into(stopped_in: int) -> None:
    """The process is stopped for 2.3 periods between looking at the clock and handing the SYNC over."""

    class StoppedBus(FakeBus):
        def send_sync(self) -> Instant:
            if self.sync_count == CALIBRATION_SYNCS + stopped_in - 1:
                self.at = Instant(self.at + 2_300_000)
            return super().send_sync()

    records, drive = list[CycleRecord](), FakeDrive(lambda cycle: 300_000)
    bus = StoppedBus([drive])
    loop = make_loop(bus, [make_axis(drive, records)])
    loop.calibrate()
    outcome = loop.run(Duration(40 * PERIOD), lambda: False, lambda at: None, lambda done: None)
    missed = [10, 11] if stopped_in == 10 else [40]
    assert (outcome.cycles, outcome.cycles_missed) == (40, len(missed))
    assert [record.sequence for record in records] == list(range(1, 41))
    assert [record.sequence for record in records if record.sync_handed_at is None] == missed
    for record in records:
        if record.sync_handed_at is not None:
            assert record.due_at <= record.sync_handed_at < record.due_at + PERIOD
            assert isinstance(record.observation, Sample)
            assert record.observation.sampled_at == record.sync_on_bus_at


@pytest.mark.parametrize("late_us", [0, 300, 499, 501, 900, 1400, 1501, 2300])
def test_no_sync_comes_within_half_a_period_of_another(late_us: int) -> None:
    bus_of: list[FakeBus] = []
    drive = FakeDrive(lambda sequence: 250_000)
    bus = FakeBus([drive])
    bus_of.append(bus)
    records: list[CycleRecord] = []
    calls = iter(range(10**9))
    loop = make_loop(
        bus,
        [make_axis(drive, records)],
        lambda _now: Duration(late_us * 1000) if next(calls) % 5 == 3 else Duration(0),
    )
    loop.calibrate()
    loop.run(Duration(60 * PERIOD), lambda: False, lambda at: None, lambda done: None)
    handed = bus.handed_at[CALIBRATION_SYNCS:]
    assert min(later - earlier for earlier, later in pairwise(handed)) >= PERIOD // 2
    assert [record.sequence for record in records] == list(range(1, 61))
    missed = sum(
        isinstance(record.observation, Dropout) and record.observation.cause is DropoutCause.MISSED
        for record in records
    )
    assert missed + len(handed) == 60
    assert (missed > 0) is (late_us > 500)
    used = [record for record in records if isinstance(record.observation, Sample)]
    assert all(record.observation.sampled_at == record.sync_on_bus_at for record in used)  # type: ignore[union-attr]


def test_a_long_stall_counts_among_the_dropouts_in_a_row() -> None:
    limits = TorqueLimits(5.0, 200.0, dropouts_consecutive_max=8)
    with pytest.raises(LimitExceeded, match="no usable reading for 9 cycles"):
        run(
            lambda cycle: 300_000,
            100,
            limits=limits,
            oversleep=lambda count: 12_000_000 if count == CALIBRATION_SYNCS + 20 else 0,
        )


def test_no_sync_is_handed_over_while_the_last_one_is_not_on_the_bus() -> None:
    records: list[CycleRecord] = []
    drive = FakeDrive(lambda sequence: 250_000)
    bus = FakeBus([drive])
    loop = make_loop(bus, [make_axis(drive, records)])
    loop.calibrate()
    came = bus.on_sync_echo
    assert came is not None

    def held(at: Instant, handed_at: Instant) -> None:
        """The echo of the tenth SYNC of the run comes 1.4 periods late, as from a bus that stood still."""
        if bus.sync_count == CALIBRATION_SYNCS + 10:
            late = Instant(at + 1_400_000)
            bus.call_at(late, lambda: came(late, handed_at))
        else:
            came(at, handed_at)

    bus.on_sync_echo = held
    loop.run(Duration(20 * PERIOD), lambda: False, lambda at: None, lambda done: None)
    causes = [
        record.observation.cause if isinstance(record.observation, Dropout) else None for record in records
    ]
    assert causes[10] is DropoutCause.MISSED
    assert records[10].woke_at is not None
    assert causes[11:] == [None] * 9, "the SYNC after it waits for half a period, and goes out"
    assert bus.handed_at[-9] - records[9].sync_on_bus_at >= PERIOD // 2  # type: ignore[operator]


def test_a_stop_request_ends_the_run_between_cycles() -> None:
    outcome, records, _ = run(lambda cycle: 300_000, 1000, stop_after=12)
    assert outcome.interrupted
    assert outcome.cycles == len(records) == 12


def test_a_stop_request_is_not_kept_waiting_for_readings() -> None:
    for stop, waits in ((True, Duration(0)), (False, TIMING.settle)):
        drive = FakeDrive(lambda sequence: 250_000)
        bus = FakeBus([drive])
        loop = make_loop(bus, [make_axis(drive, [])])
        loop.calibrate()
        outcome = loop.run(Duration(5 * PERIOD), lambda: stop, lambda at: None, lambda done: None)  # noqa: B023
        assert bus.now() - outcome.ended_at == waits


def test_a_command_expires_a_period_after_it_acts() -> None:
    _, _, drive = run(lambda cycle: 300_000, 5)
    assert {command.expires_at - command.effective_at for command in drive.commands} == {PERIOD}


def test_too_many_dropouts_in_a_row_stop_the_run() -> None:
    limits = TorqueLimits(5.0, 200.0, dropouts_consecutive_max=8)
    with pytest.raises(LimitExceeded, match="no usable reading for 9 cycles"):
        run(lambda cycle: None if cycle > 20 else 300_000, 100, limits=limits)


def test_overspeed_stops_the_run() -> None:
    def spin(drive: FakeDrive) -> None:
        drive.velocity_rad_s = -201.0

    with pytest.raises(LimitExceeded, match=r"axis1: speed -201\.0 rad/s"):
        run(lambda cycle: 300_000, 10, prepare=spin)


def test_a_drive_in_fault_stops_the_run_before_another_command() -> None:
    failed: list[FakeDrive] = []

    def fail(drive: FakeDrive) -> None:
        drive.fault = "axis1 reports a fault"
        failed.append(drive)

    with pytest.raises(DriveInFault, match="axis1 reports a fault"):
        run(lambda cycle: 300_000, 10, prepare=fail)
    assert failed[0].commands == []


def test_silence_during_calibration_is_named() -> None:
    drive = FakeDrive(lambda sequence: None)
    bus = FakeBus([drive])
    loop = make_loop(bus, [make_axis(drive, [])])
    with pytest.raises(NoAnswer, match="axis1: no reading"):
        loop.calibrate()


def test_two_axes_share_the_syncs() -> None:
    records: list[CycleRecord] = []
    drives = [FakeDrive(lambda sequence: 250_000), FakeDrive(lambda sequence: 400_000)]
    bus = FakeBus(drives)
    first = make_axis(drives[0], records)
    loop = make_loop(bus, [first, make_axis(drives[1], records, syncs=first.parts.syncs)])
    loop.calibrate()
    outcome = loop.run(Duration(10 * PERIOD), lambda: False, lambda at: None, lambda done: None)
    assert outcome.cycles == 10
    assert len(records) == 20
    assert [len(drive.commands) for drive in drives] == [10, 10]


class SpeedDrive(FakeDrive):
    """A drive that is given speeds."""

    def write(self, command: Command) -> SentCommand | None:
        assert isinstance(command, SpeedCommand)
        self.commands.append(command)
        return SentCommand(command.sequence, round(1000 * command.speed_rad_s), command.effective_at)


def test_under_limits_of_speed_an_axis_gives_speeds_within_them() -> None:
    records: list[CycleRecord] = []
    drive = SpeedDrive(lambda sequence: 250_000)
    bus = FakeBus([drive])
    loop = make_loop(bus, [make_axis(drive, records, limits=SpeedLimits(0.5, 200.0, 20.0))])
    loop.calibrate()
    loop.run(Duration(60 * PERIOD), lambda: False, lambda at: None, lambda done: None)
    speeds = [command.speed_rad_s for command in drive.commands if isinstance(command, SpeedCommand)]
    assert len(speeds) == 60
    assert max(speeds) == 0.5, "the demand is 2"
    assert max(after - before for before, after in pairwise(speeds)) == pytest.approx(0.02)
    assert all(math.isnan(command_of(record).torque_nm) for record in records)


def test_an_axis_under_limits_of_speed_moves_no_drive_that_is_given_torques() -> None:
    drive = FakeDrive(lambda sequence: 250_000)
    bus = FakeBus([drive])
    loop = make_loop(bus, [make_axis(drive, [], limits=SpeedLimits(0.5, 200.0))])
    loop.calibrate()
    with pytest.raises(ValueError, match="NaN"):
        loop.run(Duration(60 * PERIOD), lambda: False, lambda at: None, lambda done: None)
    assert drive.sent == []
