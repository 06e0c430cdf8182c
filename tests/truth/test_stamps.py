"""Drives whose stamps are coarse, late, narrow or not of microseconds, each row held against the taps."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.drivers.canopen.objects301 import DataType
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.bench import run_bench
from tests.rehearsals.made_sheet import MadeSheet
from tests.truth.drawn import drawn_plan
from tests.truth.drawn_run import judged as judged_drawn
from tests.truth.judge import Judgement, Timing, judge_axis
from tests.truth.plans import Plan
from tests.truth.rows import READING_IS_A_SET, told_by
from tests.truth.runner import bench_config
from tests.truth.tapped_run import run_with_taps
from tests.truth.truth import axis_truth

CYCLES: Final = 400


def judged(plan: Plan, told_us: float | None = None, cycles: int = CYCLES, **keys: Any) -> Judgement:
    """What the rows of a drive with ``keys`` are worth; ``told_us``: the resolution that the bench knows."""
    config = with_stamp(bench_config(plan, cycles), told_us, **keys)
    run = run_with_taps(config)
    assert not run.ended_by
    timing = Timing(config.loop.period, config.loop.deadline, config.loop.horizon_periods, plan.heard)
    truth = axis_truth(run.log, 1, READING_IS_A_SET, plan.heard)
    return judge_axis(told_by(run.rows, 0, timing.period), truth, timing)


def with_stamp(config: BenchConfig, told_us: float | None, **keys: Any) -> BenchConfig:
    drive = config.drive["axis1"]
    simulation = drive.simulation.model_copy(update=keys)
    changed = drive.model_copy(update={"simulation": simulation, "stamp_resolution_us": told_us})
    return config.model_copy(update={"drive": {"axis1": changed}})


LOSS: Final = 'loss = [{probability = 0.1, direction = "drive_to_host"}]'


PLANS: Final = (Plan("drift", drift_ppm=80), Plan("loss, 1003 us", LOSS, period_us=1003))


@pytest.mark.parametrize("plan", PLANS, ids=lambda plan: plan.name)
@pytest.mark.parametrize(
    ("keys", "resolution_us"),
    [({"stamp_resolution_us": 62.0}, 62.0), ({"stamp_latched": "tick"}, 62.5)],
    ids=["62 us", "next tick"],
)
def test_a_stamp_of_known_resolution_leaves_nothing_uncertain(
    plan: Plan, keys: dict[str, Any], resolution_us: float
) -> None:
    result = judged(plan, resolution_us, **keys)
    assert (result.rows, result.uncertain, result.wrong, result.bound_broken) == (CYCLES, 0, 0, 0)


@pytest.mark.parametrize("plan", PLANS, ids=lambda plan: plan.name)
@pytest.mark.parametrize(
    "keys",
    [{"stamp_resolution_us": 62.0}, {"stamp_resolution_us": 400.0}, {"stamp_latched": "tick"}],
    ids=["62 us", "400 us", "next tick"],
)
def test_a_stamp_of_unknown_resolution_makes_nothing_wrong(plan: Plan, keys: dict[str, Any]) -> None:
    """The bench takes it for 1 us: a residual is then the stamp's, no SYNC that came late to the drive."""
    result = judged(plan, **keys)
    assert (result.wrong, result.bound_broken) == (0, 0)


@pytest.mark.parametrize("jitter_us", [10.0, 30.0, 150.0])
@pytest.mark.parametrize("step_us", [-350, 20_000])
def test_a_clock_that_is_set_is_found_behind_the_jitter_of_the_sync(jitter_us: float, step_us: int) -> None:
    """Half of the rows stayed in doubt, to the end of the run. Eight readings tell the new line, so the first
    bounds behind it rest on little: one of 800 does not hold at 150 us."""
    plan = Plan("step", f"clock_step = [{{at_s = 0.3, step_us = {step_us}}}]", drift_ppm=80)
    result = judged(plan, cycles=800, sync_jitter_us=jitter_us)
    assert (result.wrong, result.uncertain <= 100) == (0, True)
    assert result.bound_broken <= (1 if jitter_us == 150.0 else 0)


def test_a_clock_that_is_set_by_whole_periods_is_found_behind_jitter_and_a_tick() -> None:
    """What the map errs by hid how far stamps scatter, so none of their lines was found: 624 rows wrong."""
    plan = Plan("step", "clock_step = [{at_s = 0.3, step_us = -6000}]", period_us=2000)
    result = judged(plan, 63.5, cycles=800, stamp_latched="tick", sync_jitter_us=347.0)
    assert (result.wrong, result.bound_broken) == (0, 0)
    assert result.uncertain <= 50


@pytest.mark.parametrize("faults", ["", "delay = [{delay_min_us = 0, delay_max_us = 300}]"])
@pytest.mark.parametrize("jitter_us", [5.0, 150.0])
def test_without_stamps_the_bound_holds_a_sync_that_is_late_to_the_drive(
    faults: str, jitter_us: float
) -> None:
    """Also what the three bits hide that the bus is idle behind the SYNC."""
    result = judged(Plan("jitter", faults, stamps=False), sync_jitter_us=jitter_us, cycles=1000)
    assert (result.rows, result.wrong, result.bound_broken, result.uncertain) == (1000, 0, 0, 0)


@pytest.mark.parametrize("jitter_us", [10.0, 30.0, 150.0])
def test_a_sync_that_reaches_the_drive_with_jitter_leaves_little_uncertain(jitter_us: float) -> None:
    """Of its task or of a gateway, behind the echo: how far stamps lie from their SYNCs is measured."""
    result = judged(Plan("jitter", drift_ppm=80), sync_jitter_us=jitter_us, cycles=1000)
    assert (result.rows, result.wrong, result.bound_broken) == (1000, 0, 0)
    assert result.uncertain <= 10


def test_the_steps_of_a_stamp_are_found_while_the_clock_is_learned() -> None:
    """By 1 ms: the readings are placed by their order, as they came within a period."""
    result = judged(Plan("drift, 1003 us", drift_ppm=115, period_us=1003), stamp_resolution_us=1000.0)
    assert (result.wrong, result.bound_broken, result.uncertain) == (0, 0, 0)


@pytest.mark.parametrize("plan", PLANS, ids=lambda plan: plan.name)
def test_a_stamp_too_coarse_to_tell_is_no_worse_than_none(plan: Plan) -> None:
    result, without = judged(plan, 400.0, stamp_resolution_us=400.0), judged(replace(plan, stamps=False))
    assert (result.wrong, result.bound_broken, result.uncertain_wrong) == (0, 0, 0)
    assert max(result.uncertain, without.uncertain) <= 9


@pytest.mark.parametrize(("resolution_us", "by_order"), [(333.0, 0), (334.0, CYCLES)])
def test_order_places_what_a_third_of_a_period_leaves_open(resolution_us: float, by_order: int) -> None:
    config = with_stamp(bench_config(Plan("quiet"), CYCLES), resolution_us, stamp_resolution_us=resolution_us)
    summary = run_bench(config, bus_spec="simulated", keep=False, privileged=False)
    assert summary.timing is not None
    assert summary.timing["axes"]["axis1"]["by_order"] == by_order


@pytest.mark.parametrize("index", [0x2F31, 0x1013])
def test_a_makers_stamp_is_mapped_and_used(tmp_path: Path, index: int) -> None:
    """Elmo: the microseconds at the end of the last SYNC are in 2F31h; a drive without it may have 1013h."""
    sheet = MadeSheet()
    sheet.by(0x9A)
    if index == 0x2F31:
        sheet.drop(0x1013)
        sheet.add(index, {0: DataType.UNSIGNED32})
        sheet.set(index, AccessType="ro", PDOMapping="1")
    path = tmp_path / "elmo.eds"
    path.write_text(sheet.text())
    plan = Plan("elmo", LOSS, drift_ppm=120, deadline_us=5000)
    config = with_stamp(bench_config(plan, CYCLES), None, eds=str(path), stamp_latched="arrival")
    summary = run_bench(config, bus_spec="simulated", keep=False, privileged=False)
    assert summary.timing is not None
    timing = summary.timing["axes"]["axis1"]
    assert (timing["by_order"], timing["uncertain"]) == (0, 0), "losses leave nothing open"
    assert timing["placed"] > 300
    assert timing["clock"]["drift_ppm"] == pytest.approx(120, abs=10)


@pytest.mark.parametrize("plan", PLANS, ids=lambda plan: plan.name)
@pytest.mark.parametrize("jitter_us", [12.0, 150.0])
def test_a_stamp_latched_before_the_sampling_bounds_it_by_the_delay(plan: Plan, jitter_us: float) -> None:
    """Nobody tells the bench that the stamp is that of the SYNC: it stands still while none comes."""
    result = judged(plan, stamp_latched="arrival", sync_jitter_us=jitter_us)
    assert (result.wrong, result.bound_broken, result.uncertain) == (0, 0, 0)


def test_a_change_is_not_told_with_the_stamp_of_the_last_sync() -> None:
    """A stamp of the SYNC's arrival, taken for the instant of a change, has commands act before they came."""
    verdict = judged_drawn(
        drawn_plan(14, only=["readback by event", "sync foreign", "late stamps", "adapter"])
    )
    assert (verdict.commands.outside, verdict.commands.wrong) == (0, 0)
    assert verdict.commands.told_acting > 0


def test_a_stamp_that_stands_still_is_no_worse_than_none() -> None:
    """A counter that only a master sets, and none does."""
    for plan in PLANS:
        result, without = judged(plan, stamp_runs=False), judged(replace(plan, stamps=False))
        assert (result.wrong, result.bound_broken, result.uncertain_wrong) == (0, 0, 0)
        assert result.uncertain <= without.uncertain <= 6
