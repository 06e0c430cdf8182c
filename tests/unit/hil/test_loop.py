"""The loop and its axes against a made-up bus."""

from collections.abc import Callable

import pytest

from drivers.errors import DriveInFault, LimitExceeded, NoAnswer
from drivers.timebase import NS_PER_MS, Duration
from hil.compensation import Stamp
from hil.loop import CALIBRATION_SYNCS, Loop, LoopOutcome
from hil.safety import SafetyLimits
from hil.samples import CycleRecord, Dropout, DropoutCause, Sample
from tests.unit.hil.loop_fakes import PERIOD, TIMING, FakeBus, FakeDrive, make_axis


def run(
    delay: Callable[[int], int | None],
    cycles: int,
    *,
    oversleep: Callable[[int], int] | None = None,
    stamp_delay: int = 0,
    limits: SafetyLimits | None = None,
    stop_after: int | None = None,
    prepare: Callable[[FakeDrive], None] = lambda drive: None,
) -> tuple[LoopOutcome, list[CycleRecord], FakeDrive]:
    """Calibrate without delay trouble, then run with ``delay(cycle)``, cycles counted from 1."""
    records: list[CycleRecord] = []
    drive = FakeDrive(lambda sequence: 250_000)
    bus = FakeBus([drive])
    compensator = Stamp(Duration(stamp_delay)) if stamp_delay else None
    loop = Loop(bus, bus, [make_axis(drive, records, compensator, limits)], TIMING)
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
    assert [record.sequence for record in records] == list(
        range(CALIBRATION_SYNCS + 1, CALIBRATION_SYNCS + 41)
    )
    for record in records:
        assert isinstance(record.observation, Sample)
        assert record.estimate.sequence == record.sequence
        assert record.delay == 300_000
        assert record.observation.sampled_at == record.sync_sent_at + TIMING.sync_latency
    assert records[9].command.torque_nm == 0.0
    assert records[10].command.torque_nm == 2.0


def test_the_command_is_sent_as_soon_as_the_reading_is_there() -> None:
    _, records, _ = run(lambda cycle: 300_000, 10)
    assert {record.command_sent_at - record.due_at for record in records} == {350_000}


def test_a_lost_reading_delays_the_command_to_the_latest_moment_and_no_further() -> None:
    _, records, _ = run(lambda cycle: None if cycle == 5 else 300_000, 30)
    lost = records[4]
    assert isinstance(lost.observation, Dropout)
    assert lost.observation.cause is DropoutCause.LOST
    assert lost.delay == -1
    assert lost.estimate.sequence == records[3].sequence
    assert lost.command_sent_at - lost.due_at == 700_000
    assert records[5].command_sent_at - records[5].due_at == 350_000


def test_a_steady_delay_beyond_the_period_is_no_dropout_and_costs_no_waiting() -> None:
    _, records, _ = run(lambda cycle: 1_400_000, 120)
    assert all(isinstance(record.observation, Sample) for record in records)
    for record in records[60:]:
        assert record.estimate.sequence == record.sequence - 1
        assert record.command_sent_at - record.due_at == 450_000


def test_beyond_the_deadline_a_reading_is_late_and_not_used() -> None:
    _, records, _ = run(lambda cycle: 2_500_000 if cycle == 7 else 300_000, 30)
    assert records[6].observation.cause is DropoutCause.LATE  # type: ignore[union-attr]
    assert records[6].delay == 2_500_000
    assert all(record.estimate.sequence != records[6].sequence for record in records)


def test_an_overtaken_reading_is_stale() -> None:
    _, records, _ = run(lambda cycle: 1_700_000 if cycle == 7 else 300_000, 30)
    assert records[6].observation.cause is DropoutCause.STALE  # type: ignore[union-attr]


def test_stamp_makes_a_varying_delay_constant() -> None:
    delays = [200_000, 900_000, 1_100_000, 450_000]
    _, records, _ = run(lambda cycle: delays[cycle % 4], 80, stamp_delay=2 * NS_PER_MS)
    ages = {record.command.effective_at - record.estimate.valid_at for record in records[20:]}
    assert min(ages) >= 2 * NS_PER_MS - 20_000
    assert max(ages) < 3 * NS_PER_MS


def test_missed_ticks_are_skipped_counted_and_the_grid_kept() -> None:
    outcome, records, _ = run(
        lambda cycle: 300_000, 40, oversleep=lambda count: 3_200_000 if count == CALIBRATION_SYNCS + 9 else 0
    )
    assert outcome.ticks_missed > 0
    assert outcome.cycles + outcome.ticks_missed == 40
    first = records[0].due_at
    assert all((record.due_at - first) % PERIOD == 0 for record in records)
    assert max(record.woke_at - record.due_at for record in records) >= 3_000_000


def test_a_stop_request_ends_the_run_between_cycles() -> None:
    outcome, records, _ = run(lambda cycle: 300_000, 1000, stop_after=12)
    assert outcome.interrupted
    assert outcome.cycles == len(records) == 12


def test_too_many_dropouts_in_a_row_stop_the_run() -> None:
    limits = SafetyLimits(5.0, 200.0, dropouts_consecutive_max=8)
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
    loop = Loop(bus, bus, [make_axis(drive, [])], TIMING)
    with pytest.raises(NoAnswer, match="axis1: no reading"):
        loop.calibrate()


def test_two_axes_share_the_syncs() -> None:
    records: list[CycleRecord] = []
    drives = [FakeDrive(lambda sequence: 250_000), FakeDrive(lambda sequence: 400_000)]
    bus = FakeBus(drives)
    loop = Loop(bus, bus, [make_axis(drive, records) for drive in drives], TIMING)
    loop.calibrate()
    outcome = loop.run(Duration(10 * PERIOD), lambda: False, lambda at: None, lambda done: None)
    assert outcome.cycles == 10
    assert len(records) == 20
    assert [len(drive.commands) for drive in drives] == [10, 10]
