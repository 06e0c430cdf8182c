"""The verdict, limit by limit, and the form of the summary."""

import json
from dataclasses import replace
from typing import Any

import pytest

from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.recording.verdict_text import verdict_markdown
from servobench.hil.rows.recording_plan import AxisPlan, RecordingPlan, ReviewPlan
from servobench.hil.verdict.figures import (
    NO_TIMES,
    DropoutCounts,
    Figures,
    Percentiles,
    PositionError,
    SpeedError,
    StepResponse,
)
from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary, summarise, summary_without_run
from servobench.hil.verdict.summary_text import timing_lines
from servobench.hil.verdict.verdict import Finding, RunOutcome, VerdictKind
from tests.unit.hil.recording_tools import plan_for, whole_outcome

FIGURES = Figures(
    cycles=200,
    rows=200,
    dense=200,
    dropouts=DropoutCounts(3, 2, 1, 2),
    reading_delay_us=Percentiles(400.0, 900.0, 1_500.0),
    action_delay_us=NO_TIMES,
    action_delay_least_us=NO_TIMES,
    speed_error=SpeedError(8.0, 5.0, 1.5, 4.0),
    lateness_us=Percentiles(0.0, 0.0, 12.0),
    compute_us=Percentiles(20.0, 30.0, 45.0),
    digest="00",
    torque_rms_nm=0.5,
    step_response=StepResponse(120.0, 8.0, 40.0),
    reading_losses_in_a_row=3,
    position_error=PositionError(0.3, 0.2, 0.4),
)


def summary_with(**changes: object) -> Summary:
    limits = VerdictLimits(dropouts_percent_max=10.0, delay_p99_us_max=800.0)
    return replace(summarise(FIGURES, whole_outcome(200), limits, "runs/x", 7), **changes)  # type: ignore[arg-type]


def test_json_has_the_promised_keys() -> None:
    found = summary_with().as_json()
    assert list(found) == [
        "cycles",
        "dropouts",
        "reading_delay_us",
        "speed_error",
        "bus_load_percent",
        "realtime_factor",
        "lateness_us",
        "compute_us",
        "verdict",
        "recording",
        "seed",
        "digest",
        "drives",
        "torque_rms_nm",
        "step_response",
        "action_delay_us",
        "action_delay_least_us",
        "reading_losses_in_a_row",
        "command_losses_in_a_row",
        "command_losses_in_a_row_least",
        "position_error",
    ]
    assert list(found["dropouts"]) == ["lost", "late", "stale", "missed"]
    assert list(found["reading_delay_us"]) == list(found["lateness_us"]) == ["p50", "p99", "max"]
    assert list(found["speed_error"]) == ["peak_rad_s", "peak_percent", "rms_rad_s", "after_load_percent"]


def test_what_ended_before_its_run_has_the_same_keys_and_measured_nothing() -> None:
    summary = summary_without_run(VerdictKind.BAD_INPUT, "no such file")
    assert set(summary.as_json()) == set(summary_with().as_json())
    assert from_plain(Summary, json.loads(json.dumps(summary.as_json()))) == summary
    assert (summary.verdict.exit_status, summary.verdict.reason) == (2, "no such file")
    nothing = Percentiles(None, None, None)
    assert (summary.reading_delay_us, summary.lateness_us, summary.compute_us) == (nothing, nothing, nothing)
    assert summary.speed_error == SpeedError(None, None, None, None)
    assert (summary.cycles, summary.dropouts.total, summary.reading_losses_in_a_row) == (0, 0, 0)
    assert summary.dropouts == DropoutCounts(0, 0, 0, 0)
    assert (summary.bus_load_percent, summary.realtime_factor, summary.seed) == (None, None, None)
    assert (summary.recording, summary.digest, summary.drives) == ("", "", ())


def test_what_is_found_after_the_end_is_in_the_verdict_and_nothing_else_changes() -> None:
    summary, finding = summary_with(), Finding(VerdictKind.NOT_TRUSTWORTHY, "two stamps")
    assert summary.also(finding) == replace(summary, verdict=summary.verdict.also(finding))
    assert summary.also(finding).verdict.findings[0] == finding


def test_losses_in_a_row_are_those_that_were_counted() -> None:
    us = FIGURES.reading_delay_us
    bare = Figures(0, 0, 0, FIGURES.dropouts, us, us, us, FIGURES.speed_error, us, us, "")
    assert bare.reading_losses_in_a_row == 0
    limits = VerdictLimits(losses_in_a_row_max=0.0, dropouts_percent_max=0.0, missed_percent_max=0.0)
    checks = summarise(bare, whole_outcome(0), limits, "", 1).verdict.limits
    assert [check.value for check in checks] == [None] * 3, "without a row none was counted"


@pytest.mark.parametrize("faults", [(), ("run.rrd is incomplete",)])
def test_json_and_back(faults: tuple[str, ...]) -> None:
    summary = summary_with(recording_faults=faults)
    assert from_plain(Summary, json.loads(json.dumps(summary.as_json()))) == summary
    assert ("recording_faults" in summary.as_json()) == bool(faults)


def test_a_recording_plan_survives_json(plan: RecordingPlan) -> None:
    assert from_plain(RecordingPlan, json.loads(json.dumps(plan.as_json()))) == plan


@pytest.fixture
def plan(tmp_path_factory: pytest.TempPathFactory) -> RecordingPlan:
    review = ReviewPlan((AxisPlan("a", 1.0), AxisPlan("b", 2.0)), VerdictLimits(delay_p99_us_max=5.0))
    return replace(plan_for(tmp_path_factory.mktemp("run")), review=review, notes={"controller": "pid"})


def timing(**changes: object) -> dict[str, Any]:
    axis = {
        "placed": 190,
        "by_order": 0,
        "uncertain": 0,
        "duplicates": 0,
        "unmatched": 0,
        "error_us_max": 9.25,
        "clock_steps": 0,
        "clock": {"offset_us": 1.0, "error_us": 1.2, "drift_ppm": -999.96, "drift_error_ppm": 1.5},
        "commands_unexplained": 0,
        "readbacks_unordered": 0,
    }
    return {"sync": {"bus": {"basis": "kernel", "surplus": 0, "crowded": 0}}, "axes": {"a": axis | changes}}


def test_a_plain_run_has_a_line_for_sync_and_one_for_its_axis() -> None:
    assert timing_lines(timing()) == {
        "SYNC": "by its echo, stamped by the kernel",
        "Timing": "sampled +-9.25 us, clock -1000.0 ppm",
    }
    assert timing_lines(None) == {}


def test_what_was_not_plain_is_told() -> None:
    told = timing(clock_steps=2, uncertain=7, duplicates=3, unmatched=4, commands_unexplained=5)
    told["sync"]["bus"] |= {"basis": "none", "surplus": 1, "crowded": 2}
    assert timing_lines(told) == {
        "SYNC": "no echo: the instant is that of its hand-over, 1 of others, 2 closer than half a period",
        "Timing": "sampled +-9.25 us, clock -1000.0 ppm, set 2 times, 7 uncertain,"
        " 3 came twice, 4 answer no SYNC, 5 demands of no command",
    }


def test_a_drive_without_a_clock_is_placed_by_order() -> None:
    told = timing(by_order=190, error_us_max=100.0)
    del told["axes"]["a"]["clock"]
    assert timing_lines(told)["Timing"] == "sampled +-100 us, placed by order"


def test_no_accuracy_is_told_where_nothing_was_placed() -> None:
    assert timing_lines(timing(placed=0, error_us_max=0.0))["Timing"].startswith("no reading placed")


def test_of_several_axes_each_line_has_its_name() -> None:
    told = timing()
    told["axes"]["b"] = told["axes"]["a"]
    assert list(timing_lines(told)) == ["SYNC", "Timing of a", "Timing of b"]


def test_every_basis_of_an_echo_has_its_words() -> None:
    lines = set()
    for basis in EchoBasis:
        told = timing()
        told["sync"]["bus"]["basis"] = basis.value
        lines.add(timing_lines(told)["SYNC"])
    assert len(lines) == len(EchoBasis)


def test_the_page_tells_result_limits_and_notes(plan: RecordingPlan) -> None:
    page = verdict_markdown(plan, summary_with())
    assert page.startswith("# synthetic · NOT PASSED")
    assert "- not passed: **delay_p99_us_max = 800, found 900**" in page
    assert "| delay of readings, p99 [us] | 900 | 800 | **BROKEN** |" in page
    assert "| dropouts [%] | 4 | 10 | kept |" in page
    assert "| Dropouts | 8 (2.00 %): 3 lost, 2 late, 1 stale, 2 missed |" in page
    assert "controller `pid`" in page
    assert "| Timing | sampled +-9.25 us" in verdict_markdown(plan, summary_with(timing=timing()))
    dead = summarise(FIGURES, RunOutcome(completed=False, reason="killed"), plan.review.limits, "", 7)
    assert "| Bus load | not measured |" in verdict_markdown(plan, dead)
    long = replace(
        dead, recording_faults=("frames.arrow is incomplete: " + "no space left on the device; " * 4,)
    )
    cells = [row.split("|")[2].strip() for row in verdict_markdown(plan, long).splitlines() if "|" in row]
    assert max(map(len, cells)) <= 60, "a cell shows one line, and cuts off what is longer"
    assert "| delay of readings, p99 [us] | 900 | 5 | not measured |" in verdict_markdown(plan, dead)
    slow = verdict_markdown(plan, replace(dead, compute_us=Percentiles(20.0, 28_000.0, 3e4)))
    assert "- computing takes 28000 us (p99), the period is 1000 us: simulated time waits for it" in slow
    assert "computing takes" not in verdict_markdown(plan, summary_with())
    assert verdict_markdown(plan, None).startswith("# synthetic · running")
