"""The judge finds each kind of wrong row: rows that are right are made wrong one way at a time."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration, Instant
from servobench.virtual_bus.frame import Frame
from tests.truth.command_judge import judge_commands
from tests.truth.judge import NO_TIME, Judgement, Timing, judge_axis
from tests.truth.plans import Plan
from tests.truth.rows import (
    ACTING,
    COMMAND_LOST,
    LATE,
    LOST,
    MISSED,
    NO_INSTANT,
    STALE,
    TOLD_DTYPE,
    USED,
    Told,
)
from tests.truth.runner import bench_config
from tests.truth.tapped_run import TappedRun, run_with_taps
from tests.truth.taps import Heard
from tests.truth.truth import SPEED, STAMP, AxisTruth, axis_truth, spacings_below, steps

CYCLES = 60
ROW = 30
"""The row that is made wrong."""
TIMING = Timing(Duration(NS_PER_MS), Duration(2 * NS_PER_MS), 20)
LOSSES = 'loss = [{probability = 0.2, direction = "host_to_drive"}]'


@cache
def tapped(faults: str = "", actuation: str = "on_arrival") -> TappedRun:
    """A short run of one axis."""
    plan = Plan("judged", faults, actuation=actuation, commands=True)
    return run_with_taps(bench_config(plan, CYCLES))


@cache
def truth(faults: str = "", actuation: str = "on_arrival") -> AxisTruth:
    return axis_truth(tapped(faults, actuation).log, 1, reading_is_a_set=False)


def told_rightly(axis: AxisTruth) -> Told:
    """Rows that say what happened, made from the truth: no bench has a part in them."""
    begin = len(axis.syncs) - CYCLES
    told = np.empty(CYCLES, TOLD_DTYPE)
    for row, sync in zip(told, axis.syncs[begin:], strict=True):
        row["sequence"] = 1 + (sync.handed_at - axis.syncs[begin].handed_at) // NS_PER_MS
        row["axis"], row["certain"], row["sampled_at_error_ns"] = 0, 1, NS_PER_US
        row["due_at"] = row["woke_at"] = row["sync_handed_at"] = sync.handed_at
        row["sync_on_bus_at"] = sync.on_bus_at or NO_INSTANT
        _tell_reading(row, axis, place=begin + int(row["sequence"]) - 1)
    commands = sorted(axis.commands)[-CYCLES:]
    for row, handed_at in zip(told, commands, strict=True):
        command = axis.commands[handed_at]
        row["command_handed_at"], row["command_on_bus_at"] = handed_at, command.on_bus_at or NO_INSTANT
        row["command_fate"] = COMMAND_LOST if command.acts_at is None else ACTING
        row["command_acts_after"] = row["command_acts_by"] = command.acts_at or NO_INSTANT
    return told


def _tell_reading(row: np.void, axis: AxisTruth, place: int) -> None:
    reading = axis.syncs[place].reading
    assert reading is not None
    speed, stamp = axis.layout.sent[SPEED], axis.layout.sent[STAMP]
    values = {frame.can_id: frame for frame in reading.heard.answers}
    row["fate"], row["received_at"] = USED, reading.received_at
    row["sampled_at"], row["delay_ns"] = reading.heard.at, reading.received_at - reading.heard.at
    row["velocity_rad_s"] = speed.of(values[speed.can_id], signed=True) * 2e-3 * np.pi / 60.0
    row["device_time_ns"] = stamp.of(values[stamp.can_id], signed=False) * NS_PER_US


def judged(change: Callable[[Told], None]) -> Judgement:
    told = told_rightly(truth())
    change(told)
    return judge_axis(told, truth(), TIMING)


def test_rows_that_are_right_are_found_right() -> None:
    found = judged(lambda told: None)
    assert (found.rows, found.wrong, found.uncertain, found.unaccounted) == (CYCLES, 0, 0, 0)
    assert (found.echo_wrong, found.bound_broken, found.delay_error_us(100)) == (0, 0, 0.0)


def next_reading(told: Told) -> None:
    for name in ("received_at", "sampled_at", "velocity_rad_s", "device_time_ns"):
        told[name][ROW] = told[name][ROW + 1]


def tell(name: str, value: int) -> Callable[[Told], None]:
    def change(told: Told) -> None:
        told[name][ROW] = value

    return change


def shift(name: str, by: float) -> Callable[[Told], None]:
    def change(told: Told) -> None:
        told[name][ROW] += by

    return change


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (next_reading, "used, and answers another SYNC"),
        (shift("velocity_rad_s", 0.01), "used, and mixes two readings"),
        (shift("device_time_ns", NS_PER_US), "used, and mixes two readings"),
        (tell("fate", LOST), "lost, and came"),
        (tell("fate", LATE), "late, and was in time"),
        (tell("fate", STALE), "stale, and was the newest"),
        (tell("fate", MISSED), "missed, and its SYNC went out"),
        (shift("sync_handed_at", 1), "no SYNC was handed over then"),
        (shift("sync_handed_at", NS_PER_MS), "its SYNC is of another cycle"),
        (shift("due_at", 1), "its due is not on the grid"),
    ],
)
def test_each_wrong_row_is_found(change: Callable[[Told], None], wrong: str) -> None:
    assert judged(change).misjudged == {wrong: 1}


def test_a_wrong_row_that_is_uncertain_is_counted_apart() -> None:
    def change(told: Told) -> None:
        next_reading(told)
        told["certain"][[ROW, CYCLES - 1]] = 0

    found = judged(change)
    assert (found.wrong, found.uncertain, found.uncertain_wrong) == (0, 2, 1)
    assert (found.uncertain_last, found.uncertain_far) == (ROW, 1)


@pytest.mark.parametrize(("fate", "far"), [(LOST, 0), (STALE, 1)])
def test_what_has_not_come_at_the_end_of_a_run_may_be_uncertain(fate: int, far: int) -> None:
    def change(told: Told) -> None:
        told["fate"][CYCLES - 1], told["certain"][CYCLES - 1] = fate, 0

    found = judged(change)
    assert (found.uncertain, found.uncertain_far) == (1, far)


def test_after_a_step_of_the_clock_rows_may_be_uncertain_and_delays_off() -> None:
    axis = truth()
    told = told_rightly(axis)
    stepped = replace(axis, steps_at=(Instant(int(told["due_at"][ROW])),))
    told["certain"][CYCLES - 1] = 0
    told["delay_ns"][ROW] += NS_PER_MS
    found = judge_axis(told, stepped, TIMING)

    assert (found.uncertain_last, found.uncertain_far) == (CYCLES - 1 - ROW, 0)
    assert found.delay_error_us(100) == 0.0


def test_a_delay_a_bound_and_an_echo_that_are_off_are_found() -> None:
    assert judged(shift("delay_ns", 7_000)).delay_error_us(100) == 7.0
    assert judged(shift("sampled_at", NS_PER_US)).bound_broken == 0
    assert judged(shift("sampled_at", NS_PER_US + 1)).bound_broken == 1
    assert judged(shift("sync_on_bus_at", 1)).echo_wrong == 1


def test_a_cycle_without_a_row_is_found() -> None:
    told = np.delete(told_rightly(truth()), ROW)
    found = judge_axis(told, truth(), TIMING)
    assert found.unaccounted == 2  # the cycle, and the SYNC that nobody knows


def test_a_step_of_a_clock_is_seen_and_a_drift_is_not() -> None:
    def clock(*shown_us: int) -> list[Heard]:
        return [
            Heard(Instant(cycle * NS_PER_MS), Frame(0x080), (), shown * NS_PER_US)
            for cycle, shown in enumerate(shown_us)
        ]

    assert steps(clock(0, 1001, 2002, 3003)) == []
    assert steps(clock(0, 1000, 1650, 2650)) == [2 * NS_PER_MS]


def test_bursts_are_closer_than_they_may_be() -> None:
    instants = [Instant(at) for at in (0, 1000, 1499, 1999, 2999)]
    assert spacings_below(instants, Duration(500)) == 1


@pytest.mark.parametrize("actuation", ["on_arrival", "on_sync"])
def test_commands_that_are_told_rightly_and_wrongly(actuation: str) -> None:
    axis = truth(LOSSES, actuation)
    told = told_rightly(axis)
    found = judge_commands(told, axis)
    assert 0 < found.lost == found.told_lost < CYCLES
    assert (found.wrong, found.outside, found.echo_wrong) == (0, 0, 0)
    told_us, true_us = found.delay_us(50)
    assert told_us == true_us > 0

    acting = int(np.flatnonzero(told["command_fate"] == ACTING)[0])
    lost = int(np.flatnonzero(told["command_fate"] == COMMAND_LOST)[0])
    told["command_fate"][[acting, lost]] = COMMAND_LOST, ACTING
    assert judge_commands(told, axis).wrong == 2
    told["command_fate"][acting] = ACTING
    told["command_acts_by"][acting] += NS_PER_MS
    told["command_acts_after"][acting] += NS_PER_MS
    told["command_on_bus_at"][acting] += 1
    assert (judge_commands(told, axis).outside, judge_commands(told, axis).echo_wrong) == (1, 1)


def test_an_interval_of_acting_is_held_against_the_truth_to_the_nanosecond() -> None:
    axis = truth()
    told = told_rightly(axis)
    told["command_acts_after"][ROW] -= 1
    assert judge_commands(told, axis, NO_TIME).outside == 0
    told["command_acts_by"][ROW] -= 1
    assert (judge_commands(told, axis, NO_TIME).outside, judge_commands(told, axis).outside) == (1, 0)


def test_an_adapter_may_stamp_late_by_its_error_and_no_more() -> None:
    axis = truth()
    told = told_rightly(axis)
    told["sync_on_bus_at"] += 700
    told["command_on_bus_at"] += 700
    for error, wrong in ((700, 0), (699, CYCLES)):
        timing = replace(TIMING, stamp_error=Duration(error))
        assert judge_axis(told, axis, timing).echo_wrong == wrong
        assert judge_commands(told, axis, NO_TIME, Duration(error)).echo_wrong == wrong


def test_a_command_that_was_never_handed_over_is_found() -> None:
    told = told_rightly(truth())
    told["command_handed_at"][ROW] += 1
    assert judge_commands(told, truth()).unknown == 1


def test_commands_that_were_handed_over_in_one_instant_are_told_apart() -> None:
    axis = truth()
    told = told_rightly(axis)
    at, after = (int(told["command_handed_at"][row]) for row in (ROW, ROW + 1))
    together = [axis.commands[at], replace(axis.commands[after], handed_at=Instant(at))]
    told["command_handed_at"][ROW + 1] = at
    axis = replace(axis, commands=axis.commands | {at: together[-1]}, at_once={at: together})
    assert judge_commands(told, axis, NO_TIME).outside == 0
    told["command_acts_by"][ROW] -= 1
    assert judge_commands(told, axis, NO_TIME).outside == 1


def test_a_command_on_sync_acts_at_a_sync() -> None:
    axis = truth(LOSSES, "on_sync")
    heard_at = {sync.reading.heard.at for sync in axis.syncs if sync.reading is not None}
    acting = {command.acts_at for command in axis.commands.values() if command.acts_at is not None}
    assert len(acting) > CYCLES // 2
    assert acting <= heard_at
