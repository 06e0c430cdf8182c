"""A shift by whole periods: delays that change as a clock that is set would have it, and clocks that are."""

from typing import Literal

import pytest

from tests.truth.judge import Judgement, Timing, judge_axis
from tests.truth.plans import Plan
from tests.truth.rows import READING_IS_A_SET, told_by
from tests.truth.runner import bench_config
from tests.truth.tapped_run import run_with_taps
from tests.truth.truth import axis_truth

CYCLES = 1300
HELD = "reorder = [{probability = 0.025, held_min_us = 300, held_max_us = 3140}]\n"
"""Delays spread over three periods."""
GATEWAY = """
[[delay]]
direction = "drive_to_host"
delay_us = {}
from_s = 0.6
until_s = {}
side = "drive"
"""
CLOCK = "clock_step = [{at_s = 0.9, step_us = -1000}]\n"
UNDECIDED = "the SYNC is too regular to decide"
KNOWN_AGAIN = "which SYNCs its readings answer is known again"


def judged(
    faults: str,
    watermark_us: float,
    seed: int,
    sync: Literal["own", "foreign"] = "own",
    producer_jitter_us: int = 0,
) -> tuple[Judgement, list[str]]:
    """What the rows are worth, and what the run told of whole periods."""
    plan = Plan("shift", faults, deadline_us=9000, sync=sync, producer_jitter_us=producer_jitter_us)
    config = bench_config(plan, CYCLES)
    loop = config.loop.model_copy(update={"sync_watermark_us": watermark_us})
    bench = config.bench.model_copy(update={"seed": seed})
    run = run_with_taps(config.model_copy(update={"loop": loop, "bench": bench}))
    assert not run.ended_by
    truth = axis_truth(run.log, 1, READING_IS_A_SET, plan.heard)
    timing = Timing(loop.period, loop.deadline, loop.horizon_periods, plan.heard)
    told = [event for event in run.events if UNDECIDED in event or KNOWN_AGAIN in event]
    return judge_axis(told_by(run.rows, 0, timing.period), truth, timing), told


@pytest.mark.parametrize("seed", [2, 4])
def test_a_gateway_whose_delay_changes_is_no_clock_that_was_set(seed: int) -> None:
    result, told = judged(HELD + GATEWAY.format(4498, 1.1), 0.0, seed)
    assert (result.wrong, result.bound_broken, told) == (0, 0, [])
    assert result.uncertain <= 20


@pytest.mark.parametrize("watermark_us", [0.0, 5.0])
@pytest.mark.parametrize("seed", [1, 3])
def test_a_clock_that_is_set_by_a_period_is_found(watermark_us: float, seed: int) -> None:
    """By a SYNC that goes out late for it, where its own unevenness does not show it: 396 rows were wrong."""
    result, told = judged(HELD + CLOCK, watermark_us, seed)
    assert (result.wrong, result.bound_broken, told) == (0, 0, [])
    assert result.uncertain <= 50


def test_a_clock_that_is_set_back_by_a_period_is_found_behind_a_sync_that_is_too_regular() -> None:
    """One SYNC has two stamps then, which no longer delay makes: some 500 rows were in doubt."""
    result, told = judged(CLOCK, 0.0, 1, "foreign")
    assert (result.wrong, result.bound_broken, told) == (0, 0, [])
    assert result.uncertain <= 20


def test_behind_a_sync_that_is_too_regular_a_delay_of_whole_periods_leaves_the_rows_in_doubt() -> None:
    """Of another node, whose SYNCs no unevenness marks, and none goes out late: to the end of the run."""
    result, told = judged(GATEWAY.format(2000, 99), 0.0, 1, "foreign")
    assert (result.wrong, result.bound_broken) == (0, 0)
    assert 300 < result.uncertain < 800
    (undecided,) = told
    assert UNDECIDED in undecided


def test_a_delay_that_is_again_what_it_was_ends_the_doubt() -> None:
    result, told = judged(GATEWAY.format(2000, 1.1), 0.0, 1, "foreign")
    assert (result.wrong, result.bound_broken) == (0, 0)
    assert 400 < result.uncertain < 550
    assert [UNDECIDED in told[0], *told[1:]] == [True, f"axis1: {KNOWN_AGAIN}"]


@pytest.mark.parametrize("faults", [CLOCK, GATEWAY.format(2000, 1.1)], ids=["a clock", "a gateway"])
def test_the_jitter_of_another_s_sync_decides(faults: str) -> None:
    result, told = judged(HELD + faults, 0.0, 1, "foreign", producer_jitter_us=20)
    assert (result.wrong, result.bound_broken, told) == (0, 0, [])
    assert result.uncertain <= 60


def test_where_nothing_shifts_a_regular_sync_leaves_nothing_in_doubt() -> None:
    result, told = judged(HELD, 0.0, 1, "foreign")
    assert (result.wrong, result.bound_broken, told) == (0, 0, [])
    assert result.uncertain <= 10


@pytest.mark.parametrize("jitter_us", [0, 400])
def test_readings_that_come_behind_the_next_sync_teach_no_clock(jitter_us: int) -> None:
    """While calibrating with another's SYNCs they were taken for that one's: 243 of 1300 rows were wrong."""
    slow = "slow_drive = [{tpdo_delay_min_us = 0, tpdo_delay_max_us = 1800}]"
    result, told = judged(slow, 0.0, 2, "foreign", producer_jitter_us=jitter_us)
    assert (result.wrong, result.bound_broken, told) == (0, 0, [])
    assert result.uncertain <= 20
