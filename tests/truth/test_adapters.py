"""Adapters that stamp late, or bring frames in another order than the bus had them, held against the taps."""

from dataclasses import replace
from typing import Any

import pytest

from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.drivers.wire.frame_port import EchoBasis
from tests.truth.adapter import STAMP_TICK_NS, Adapter
from tests.truth.judge import Judgement, Timing, judge_axis
from tests.truth.plans import Plan
from tests.truth.rows import READING_IS_A_SET, told_by
from tests.truth.runner import bench_config
from tests.truth.tapped_run import Surroundings, run_with_taps
from tests.truth.truth import axis_truth

CYCLES = 400


def judged(basis: EchoBasis, late_us: float, *, stamps: bool, cycles: int = CYCLES, **keys: Any) -> Judgement:
    return judged_behind(Adapter(basis, late_us), cycles, stamps=stamps, **keys)


def judged_behind(adapter: Adapter, cycles: int, **keys: Any) -> Judgement:
    plan = replace(Plan("adapter", deadline_us=5000, drift_ppm=80), **keys)
    config = bench_config(plan, cycles)
    run = run_with_taps(config, Surroundings(adapter=adapter))
    assert not run.ended_by
    error = Duration(
        STAMP_TICK_NS if adapter.basis is EchoBasis.HARDWARE else round(adapter.late_us * NS_PER_US)
    )
    timing = Timing(config.loop.period, config.loop.deadline, config.loop.horizon_periods, plan.heard, error)
    truth = axis_truth(run.log, 1, READING_IS_A_SET, plan.heard)
    return judge_axis(told_by(run.rows, 0, timing.period), truth, timing)


@pytest.mark.parametrize("stamps", [True, False])
@pytest.mark.parametrize("late_us", [120.0, 900.0])
def test_a_reading_that_is_fetched_before_the_echo_of_its_sync_waits_for_it(
    late_us: float, stamps: bool
) -> None:
    """As of a USB adapter that brings both from different queues, each with the stamp of its own clock."""
    result = judged(EchoBasis.HARDWARE, late_us, stamps=stamps)
    assert (result.rows, result.uncertain, result.wrong, result.bound_broken) == (CYCLES, 0, 0, 0)


@pytest.mark.parametrize(
    ("basis", "late_us", "stamps"),
    [(EchoBasis.KERNEL, 900.0, True), (EchoBasis.RECEIPT, 500.0, True), (EchoBasis.RECEIPT, 500.0, False)],
)
def test_syncs_whose_echoes_are_stamped_late_are_placed_by_their_hand_over(
    basis: EchoBasis, late_us: float, stamps: bool
) -> None:
    """Readings follow the hand-over more evenly: 67 of 1000 rows were wrong, 820 in doubt."""
    result = judged(basis, late_us, stamps=stamps)
    assert (result.rows, result.uncertain, result.wrong, result.bound_broken) == (CYCLES, 0, 0, 0)


def test_the_bound_holds_what_an_echo_is_stamped_late() -> None:
    """By less than this basis is assumed to err: the echoes stay what SYNCs are placed by."""
    result = judged(EchoBasis.RECEIPT, 190.0, stamps=True)
    assert (result.rows, result.wrong, result.bound_broken) == (CYCLES, 0, 0)


@pytest.mark.parametrize("late_us", [300.0, 650.0])
def test_another_s_syncs_that_are_stamped_late_show_no_steps_of_stamps(late_us: float) -> None:
    """At equal distances, to a clock that does not drift, all stamps are multiples of the period. The bench
    took that for the step of the stamp, and put 94 % of the rows in doubt."""
    result = judged(EchoBasis.RECEIPT, late_us, stamps=True, cycles=1000, sync="kernel", drift_ppm=0.0)
    assert (result.wrong, result.bound_broken) == (0, 0)
    assert result.uncertain <= 100


@pytest.mark.parametrize("first_late_us", [3800, 3900, 4000])
@pytest.mark.parametrize("second_late_us", [1500, 2000, 2060])
def test_syncs_that_a_hub_brings_to_the_drive_together_are_in_doubt(
    first_late_us: int, second_late_us: int
) -> None:
    """Its process stands still for 4 ms behind the end of a SYNC; the host goes on after two periods. The
    drive hears both SYNCs then, at instants of its own that may be one and the same, and that of the next
    SYNC: two readings were taken for copies of a third, which was a certain row of another SYNC."""
    behind = 'direction = "host_to_drive", frames = ["sync"], side = "drive"'
    faults = (
        f"{{{behind}, delay_us = {first_late_us}, from_s = 0.1998, until_s = 0.2005}}",
        f"{{{behind}, delay_us = {second_late_us}, from_s = 0.2015, until_s = 0.2025}}",
    )
    adapter = Adapter(EchoBasis.BUS, 0.0, still_us=(407_700, 411_700))
    result = judged_behind(
        adapter, CYCLES, deadline_us=2000, drift_ppm=0.0, faults=f"delay = [{', '.join(faults)}]"
    )

    assert (result.rows, result.wrong, result.bound_broken) == (CYCLES, 0, 0)
    assert result.uncertain <= 6, "three SYNCs around each time that it stood still"
