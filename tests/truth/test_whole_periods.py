"""A shift by whole periods: delays that change as a clock that is set would have it, and clocks that are."""

import pytest

from tests.truth.judge import Judgement, Timing, judge_axis
from tests.truth.plans import Plan
from tests.truth.rows import READING_IS_A_SET, told_by
from tests.truth.runner import bench_config
from tests.truth.tapped_run import run_with_taps
from tests.truth.truth import axis_truth

CYCLES = 1300
GATEWAY = """
reorder = [{probability = 0.025, held_min_us = 300, held_max_us = 3140}]
[[delay]]
direction = "drive_to_host"
delay_us = 4498
from_s = 0.6
until_s = 1.1
side = "drive"
"""
CLOCK = """
reorder = [{probability = 0.025, held_min_us = 300, held_max_us = 3140}]
clock_step = [{at_s = 0.9, step_us = -1000}]
"""


def judged(faults: str, watermark_us: float, seed: int) -> Judgement:
    config = bench_config(Plan("shift", faults, deadline_us=9000), CYCLES)
    loop = config.loop.model_copy(update={"sync_watermark_us": watermark_us})
    bench = config.bench.model_copy(update={"seed": seed})
    run = run_with_taps(config.model_copy(update={"loop": loop, "bench": bench}))
    assert not run.ended_by
    truth = axis_truth(run.log, 1, READING_IS_A_SET, syncs_heard=False)
    timing = Timing(loop.period, loop.deadline, loop.horizon_periods)
    return judge_axis(told_by(run.rows, 0, timing.period), truth, timing)


@pytest.mark.parametrize("seed", [2, 4])
def test_a_gateway_whose_delay_changes_is_no_clock_that_was_set(seed: int) -> None:
    result = judged(GATEWAY, 0.0, seed)
    assert (result.wrong, result.bound_broken) == (0, 0)


@pytest.mark.parametrize("seed", [1, 3])
def test_a_watermark_shows_a_clock_that_is_set_by_a_period(seed: int) -> None:
    assert judged(CLOCK, 5.0, seed).wrong == 0
