"""A recorded run judged anew from its rows, and its report; against counts by hand."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.recorded import paper
from servobench.hil.recorded.judgement import Judged, _certified, judge_run, load_requirements
from servobench.hil.recorded.recorded_run import signals_of
from servobench.hil.recorded.report import write_report
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.figures import Percentiles
from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.summary_text import limit_rows
from servobench.hil.verdict.verdict import (
    Check,
    Demand,
    Finding,
    LimitResult,
    RunVerdict,
    VerdictKind,
    not_run,
)
from tests.unit.hil.made_runs import MadeRun, made_run
from tests.unit.hil.recording_tools import RESTING
from tests.unit.hil.row_tools import plain_rows
from tests.unit.hil.test_report import summary
from tests.unit.hil.test_summary import FIGURES, timing

CYCLES = 2_000
"""All that the example plans."""
DIGEST = "cd" * 16
LIMITS = VerdictLimits(losses_in_a_row_max=1.0, delay_p99_us_max=500.0)


def rows(lost: int = 2) -> Rows:
    made = plain_rows(CYCLES, reference=100.0, velocity=99.0)
    made["delay_ns"] = 400_000
    made["fate"][300 : 300 + lost] = 1
    made["compute_ns"] = 20_000
    return made


def its_own(run: MadeRun, **more: Any) -> MadeRun:
    """The same with the summary that its rows give."""
    figures = judge_run(run).summary
    own = replace(run.summary, cycles=figures.cycles, digest=figures.digest, drives=(RESTING,), **more)
    return replace(run, summary=own)


def run_of(limits: VerdictLimits = LIMITS, **more: Any) -> MadeRun:
    run = made_run(rows(), limits=limits, batch=1_000, first_cycle=7_000_000_000)
    return its_own(run, **more)


def test_a_run_is_judged_by_its_rows_and_its_own_limits() -> None:
    judged = judge_run(run_of())
    assert judged.against == "the bench's own limits"
    found = judged.summary
    assert (found.cycles, found.dropouts.lost, found.reading_losses_in_a_row) == (CYCLES, 2, 2)
    assert (found.seed, found.recording) == (2012, "one")
    assert (found.bus_load_percent, found.realtime_factor) == (51.4, 38.2), "what rows cannot tell"
    assert found.verdict.limits == (
        Check("delay_p99_us_max", 400.0, 500.0, LimitResult.KEPT, "axis1", None),
        Check("losses_in_a_row_max", 2.0, 1.0, LimitResult.BROKEN, "axis1", 301_000_000),
    )
    assert found.verdict.outcome is VerdictKind.NOT_PASSED
    times, values = judged.signals.signals["axis1/speed/measured"].points()
    assert (times[0], times.size) == (0, CYCLES - 2), "in run time"
    assert set(np.round(values, 6)) == {round(99.0 * 30.0 / np.pi, 6)}


def test_other_requirements_take_the_place_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "asked.toml"
    path.write_text("[verdict]\nlosses_in_a_row_max = 2\ncompute_us_max = 1.0\n")
    run = run_of()
    judged = judge_run(run, path)
    assert judged.against == str(path)
    assert [check.metric for check in judged.summary.verdict.limits] == ["losses_in_a_row_max"]
    assert judged.summary.verdict.outcome is VerdictKind.PASSED
    assert judged.run.review.limits.losses_in_a_row_max == 2
    real = judge_run(replace(run, metadata={**run.metadata, "time": "real"}), path).summary.verdict
    assert [(check.metric, check.value) for check in real.limits] == [
        ("compute_us_max", 20.0),
        ("losses_in_a_row_max", 2.0),
    ]


def test_settling_and_its_band_are_those_that_are_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "asked.toml"
    path.write_text("[verdict]\nsettling_ms = 33\nsettling_band_percent = 7.0\nlosses_in_a_row_max = 2\n")
    review = judge_run(run_of(), path).run.review
    assert (review.settling, review.band_percent) == (33_000_000, 7.0)


def test_requirements_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput) as missing:
        load_requirements(tmp_path / "none.toml")
    assert missing.value.source == "--against"
    path = tmp_path / "asked.toml"
    path.write_text("[verdict]\novershoot = 1.0\n")
    with pytest.raises(BadInput) as caught:
        load_requirements(path)
    assert (caught.value.source, caught.value.key) == (str(path), "verdict.overshoot")


@pytest.mark.parametrize(
    ("cycles", "told"),
    [
        (CYCLES - 1, f"records.arrow has {CYCLES} cycles, the run had {CYCLES - 1}"),
        (CYCLES, f"records.arrow has the digest {{}}, the run had {DIGEST}"),
    ],
)
def test_rows_of_another_run_are_told(cycles: int, told: str) -> None:
    run = run_of(VerdictLimits())
    digest = run.summary.digest
    other = replace(run, summary=replace(run.summary, cycles=cycles, digest=DIGEST))
    verdict = judge_run(other).summary.verdict
    assert verdict.of(VerdictKind.NOT_RECORDED) == (told.format(digest),)
    assert judge_run(run).summary.verdict.of(VerdictKind.NOT_RECORDED) == ()


def test_what_the_recording_lacked_it_lacks() -> None:
    found = judge_run(run_of(recording_faults=("7 rows",))).summary
    assert found.recording_faults == ("7 rows",)
    assert found.verdict.of(VerdictKind.NOT_RECORDED) == ("7 rows",)


def with_verdict(verdict: RunVerdict) -> MadeRun:
    return run_of(VerdictLimits(losses_in_a_row_max=9.0), verdict=verdict)


def test_what_no_limit_found_stays_found_and_what_limits_found_does_not() -> None:
    before = summary(passed=False).verdict.also(Finding(VerdictKind.NOT_TRUSTWORTHY, "came too early"))
    before = before.also(Finding(VerdictKind.NOT_MEASURED, "of a limit"))
    found = judge_run(with_verdict(before)).summary.verdict
    assert found.findings == (Finding(VerdictKind.NOT_TRUSTWORTHY, "came too early"),)
    assert found.completed


def test_what_others_did_to_a_run_stays_and_is_told_by_the_limits_that_it_is_held_against() -> None:
    disturbed = Finding(VerdictKind.DISTURBED, "a SYNC that the bench did not send")
    found = judge_run(with_verdict(summary().verdict.also(disturbed))).summary.verdict
    assert (found.outcome, found.exit_status) == (VerdictKind.PASSED_DISTURBED, 4)
    assert (found.findings, found.reason) == ((disturbed,), disturbed.text)
    unasked = judge_run(run_of(VerdictLimits(), verdict=summary().verdict.also(disturbed))).summary.verdict
    assert unasked.outcome is VerdictKind.COMPLETED_DISTURBED


def test_a_run_that_was_cut_short_stays_so_with_its_cause() -> None:
    found = judge_run(with_verdict(not_run(VerdictKind.PEER_FAULT, "the drive is gone"))).summary.verdict
    assert found.findings == (Finding(VerdictKind.PEER_FAULT, "the drive is gone"),)
    assert not found.completed
    assert found.limits[0].result is LimitResult.NOT_MEASURED


def certified(**changes: Any) -> list[Demand]:
    certificate = {
        "action_delay_us": {"seen": 900.0, "certified": 1_000.0},
        "losses_together": {"seen": 1, "seen_at_most": 3, "certified": 2},
        "gain_rad_s_nm": {"seen": 9.0, "seen_at_least": 7.0, "certified": 8.0},
        "commands_at_a_limit": 4,
        "premises_left": [],
        **changes,
    }
    return list(_certified(replace(FIGURES, certificates={"axis1": certificate})))


DELAY = Demand("certified_action_delay_us", "axis1", 900.0, 1_000.0)
LOSSES = Demand("certified_losses_together", "axis1", 3, 2)
AT_LIMIT = Demand("certified_commands_at_a_limit", "axis1", 4.0, 0.0)
GAIN = Demand("certified_gain_rad_s_nm", "axis1", 7.0, 8.0)


@pytest.mark.parametrize(
    ("changes", "demands"),
    [
        ({}, [DELAY, LOSSES, AT_LIMIT, GAIN]),
        ({"premises_left": ["losses"]}, [DELAY, LOSSES, AT_LIMIT]),
        ({"action_delay_us": {"seen": 900.0, "certified": None}}, [LOSSES, AT_LIMIT, GAIN]),
        ({"gain_rad_s_nm": {"seen": 9.0, "seen_at_least": 7.0, "certified": None}}, [DELAY, LOSSES]),
    ],
)
def test_a_certificate_asks_for_what_it_presumes_and_allows(
    changes: dict[str, Any], demands: list[Demand]
) -> None:
    assert certified(**changes) == demands


def judged(found: Summary | None = None, folder: Path = Path("one"), **metadata: str) -> Judged:
    run = made_run(rows(), folder=str(folder))
    run = replace(run, metadata={**run.metadata, **metadata})
    return Judged(run, "asked.toml", found or judge_run(run_of()).summary, signals_of(run))


@pytest.fixture
def plain_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are looked at elsewhere."""
    monkeypatch.setattr(paper, "svg_text", lambda _figure: "<svg>x</svg>")


def report(path: Path, its: Judged) -> str:
    write_report(its, path)
    return path.read_text(encoding="utf-8")


def test_requirements_are_rows_of_words() -> None:
    assert list(limit_rows(judged().summary.verdict.limits)) == [
        ("delay of readings, p99 [us]", "400", "500", "kept", "axis1"),
        ("readings lost in a row", "2", "1", "broken", "axis1 at 0.301 s"),
    ]
    cut = replace(summary(), verdict=summary(completed=False).verdict)
    assert [row[1:] for row in limit_rows(judged(cut).summary.verdict.limits)] == [
        ("4.25", "10", "not measured", ""),
        ("3", "5", "not measured", ""),
        ("999", "2000", "not measured", ""),
    ]


@pytest.mark.usefixtures("plain_pictures")
def test_a_report_in_markdown_is_whole(tmp_path: Path) -> None:
    events = [
        {"at_ns": 1_500_000_000, "level": "WARN", "text": "a | b"},
        {"at_ns": 2_000_000_000, "level": "INFO", "text": "no"},
        {"at_ns": 2_500_000_000, "level": "ERROR"},
        {"at_ns": 3_000_000_000, "level": "CRITICAL", "text": "last"},
    ]
    (tmp_path / "events.jsonl").write_text("\n".join(map(json.dumps, events)))
    drives, host = json.dumps({"axis1": "a servo"}), json.dumps({"kernel": "6.1", "cores": "2"})
    its = judged(folder=tmp_path, drives=drives, host=host, seed="7", commit="")
    parts = report(tmp_path / "r.md", its).removesuffix("\n").split("\n\n")
    assert parts[0] == "# ling2012: NOT PASSED"
    picture = "data:image/svg+xml;base64,PHN2Zz54PC9zdmc+"
    assert parts[1:6] == [
        "## Requirements",
        "| requirement | value | at most |  | worst |\n|:--|:--|:--|:--|:--|\n"
        "| delay of readings, p99 [us] | 400 | 500 | kept | axis1 |\n"
        "| readings lost in a row | 2 | 1 | broken | axis1 at 0.301 s |",
        f"![Speed, error, torque and delay; dashed: limits]({picture})",
        f"![Delays of the readings]({picture})",
        "## Findings",
    ]
    assert parts[6] == "|  |  |\n|:--|:--|\n| not passed | losses_in_a_row_max = 1, found 2 |"
    assert parts[7::2] == ["## Figures", "## Run", "## Warnings and errors"]
    assert parts[10].splitlines()[2:] == [
        f"| folder | {tmp_path} |",
        "| seal | unsealed: requested by --unsealed |",
        "| judged by | asked.toml |",
        "| bench | ling2012 |",
        "| bus | - |",
        "| seed | 7 |",
        "| time | simulated |",
        "| servobench | - |",
        "| commit | - |",
        "| drive of axis1 | a servo |",
        "| host | kernel 6.1, cores 2 |",
    ]
    told = parts[12].splitlines()[2:]
    assert told == ["| 1.500000 | WARN | a / b |", "| 3.000000 | CRITICAL | last |"]


@pytest.mark.usefixtures("plain_pictures")
def test_the_figures_of_a_report_are_those_of_the_summary(tmp_path: Path) -> None:
    whole = replace(summary(), timing=timing(), reading_losses_in_a_row=6, torque_rms_nm=0.12345)
    text = report(tmp_path / "r.md", judged(whole))
    table = text.split("## Figures\n\n")[1].split("\n\n")[0].splitlines()[2:]
    assert table[:10] == [
        "| Cycles | 2000 of 2000 planned, 1 axis |",
        "| Tracking error | peak 6.68 rad/s (4.25 %), rms 0.7 rad/s |",
        "| After load step | not measured |",
        "| Torque | 0.1235 N m rms about its mean in steady state |",
        "| Reading delay | p50 612 us, p99 987.5 us, max 1044 us |",
        "| Action delay | p50 - us, p99 - us, max - us |",
        "| Lateness | p50 0 us, p99 0 us, max 0 us |",
        "| Computing | p50 12 us, p99 20 us, max 88 us |",
        "| Dropouts | 96 (4.80 %): 90 lost, 5 late, 1 stale, 0 missed |",
        "| Lost in a row | 6 readings, commands not measured |",
    ]
    titles = [line.split(" | ")[0] for line in table[10:]]
    assert titles == ["| SYNC", "| Timing", "| Bus load", "| Pace", "| Digest"]
    none = replace(summary(), reading_delay_us=Percentiles(None, None, None))
    assert "| Reading delay | p50 - us, p99 - us, max - us |" in report(tmp_path / "n.md", judged(none))


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.parametrize(
    ("found", "style"),
    [
        (summary(), "verdict passed"),
        (summary(limits=VerdictLimits()), "verdict passed"),
        (summary(passed=False), "verdict"),
        (summary(completed=False), "verdict"),
    ],
)
def test_a_page_says_at_once_what_it_came_to(tmp_path: Path, found: Summary, style: str) -> None:
    text = report(tmp_path / "r.html", judged(found))
    assert text.startswith(
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width'><title>ling2012</title>"
    )
    assert text.endswith("</body></html>\n")
    assert text.split("<body><h1>ling2012</h1>")[1].startswith(f"<p class='{style}'>")
    figure = "<figure><svg>x</svg><figcaption>{}</figcaption></figure>".format
    pictures = figure("Speed, error, torque and delay; dashed: limits") + figure("Delays of the readings")
    assert text.count(pictures) == 1
    assert ("<h2>Findings</h2>" in text) == bool(found.verdict.findings)
    assert "<h2>Warnings and errors</h2>" not in text, "there are none"


@pytest.mark.usefixtures("plain_pictures")
def test_a_requirement_has_the_style_of_its_result(tmp_path: Path) -> None:
    text = report(tmp_path / "r.html", judged(summary(passed=False)))
    row = "<tr><td>{}</td><td>{}</td><td>{}</td><td class='{}'>{}</td><td></td></tr>".format
    table = text.split("<h2>Requirements</h2><table>")[1].split("</table>")[0]
    assert table == (
        "<tr><th>requirement</th><th>value</th><th>at most</th><th></th><th>worst</th></tr>"
        + row("speed error, peak [%]", "4.25", "10", "kept", "kept")
        + row("speed error after load step [%]", "3", "5", "kept", "kept")
        + row("delay of readings, p99 [us]", "2345", "2000", "broken", "broken")
    )


@pytest.mark.usefixtures("plain_pictures")
def test_no_more_than_the_last_two_hundred_events_are_told(tmp_path: Path) -> None:
    lines = [json.dumps({"at_ns": place, "level": "WARN", "text": f"event {place}."}) for place in range(250)]
    (tmp_path / "events.jsonl").write_text("\n".join(lines))
    text = report(tmp_path / "r.md", judged(folder=tmp_path))
    told = [line for line in text.splitlines() if "| WARN |" in line]
    assert len(told) == 200
    assert "event 50." in told[0]
    assert "event 249." in told[-1]


def test_a_report_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput) as caught:
        write_report(judged(), tmp_path / "r.pdf")
    told = f"--report: found '{tmp_path / 'r.pdf'}', expected a file that ends in .html or .md"
    assert str(caught.value) == told


@pytest.mark.parametrize("name", ["reference_position_rad", "reference_torque_nm", "command_speed_rad_s"])
def test_a_column_that_was_overwritten_is_no_pass(name: str) -> None:
    run = run_of(VerdictLimits())
    batches = tuple(each.copy() for each in run.batches)
    batches[1][name] = batches[1]["velocity_rad_s"]
    (told,) = judge_run(replace(run, batches=batches)).summary.verdict.of(VerdictKind.NOT_RECORDED)
    assert told.startswith("records.arrow has the digest ")
