"""The page of a run beside its plots: every row of it, while the run goes on and when it has ended."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.hil.recording.verdict_text import running_markdown, verdict_markdown
from servobench.hil.rows.recording_plan import AxisPlan, ReviewPlan
from servobench.hil.verdict.figures import DropoutCounts, Percentiles, SpeedError, StepResponse
from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.summary import checks_so_far
from servobench.hil.verdict.verdict import Check, LimitResult
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.test_summary import FIGURES, summary_with

PLAN: Final = replace(plan_for(Path("run")), notes={"controller": "pid"})
TOLD: Final = {
    "drives": '{"axis1": "a drive"}',
    "first_cycle_epoch_ns": str(1_700_000_000 * 10**9 + 500_000_000),
    "time": "real",
    "host": json.dumps({"name": "lab", "system": "Linux 6.1", "python": "3.12"}),
    "servobench": "1.2",
    "commit": "0123456789abcdef-dirty",
}
ORIGIN: Final = "bus `simulated` · controller `pid` · seed `2012`"


@pytest.mark.parametrize(
    ("metadata", "origin"),
    [
        (None, ORIGIN),
        ({}, ORIGIN),
        (
            TOLD,
            f"{ORIGIN} · drive of axis1 `a drive` · first cycle `2023-11-14 22:13:20 UTC` · "
            "host `lab, Linux 6.1, Python 3.12` · servobench `1.2 0123456789ab`",
        ),
        (
            {"first_cycle_epoch_ns": "1", "time": "simulated", "commit": "0123456789abcdef"},
            f"{ORIGIN} · first cycle `in simulated time` · servobench `0123456789ab`",
        ),
        ({"servobench": "1.2"}, f"{ORIGIN} · servobench `1.2`"),
    ],
)
def test_who_ran_what_and_when(metadata: dict[str, str] | None, origin: str) -> None:
    assert verdict_markdown(PLAN, None, metadata) == f"# synthetic · running\n\n{origin}\n"


def test_the_figures_so_far() -> None:
    figures = replace(
        FIGURES,
        dropouts=DropoutCounts(3, 2, 1, 4),
        reading_delay_us=Percentiles(400.0, 900.0, 1500.4),
        lateness_us=Percentiles(None, None, None),
        speed_error=SpeedError(8.0, None, 1.5, 4.0),
        step_response=StepResponse(120.0, 8.26, 40.0),
    )
    limits = VerdictLimits(
        after_load_percent_max=5.0, speed_error_rms_rad_s_max=1.2, bus_load_percent_max=70.0
    )
    page = running_markdown(PLAN, figures, checks_so_far(figures, limits), {})
    assert page == (
        f"# synthetic · running, A LIMIT IS BROKEN\n\n{ORIGIN}\n\n"
        "| limit | so far | at most | | worst |\n|:--|--:|--:|:--|:--|\n"
        "| speed error after load step [%] | 4 | 5 | kept |  |\n"
        "| speed error, RMS [rad/s] | 1.5 | 1.2 | **BROKEN** |  |\n"
        "| bus load [%] | - | 70 | not measured |  |\n\n"
        "| figure so far | value |\n|:--|:--|\n"
        "| Cycles | 200 |\n"
        "| Tracking error | peak 8 rad/s (- %), rms 1.5 rad/s |\n"
        "| After load step | 4 % at most |\n"
        "| Position error | peak 0.3 rad, rms 0.2 rad, following 0.4 rad |\n"
        "| Step response | settled after 120 ms, overshoot 8.26 % |\n"
        "| Recovery | 40 ms after a load step |\n"
        "| Torque | 0.5 N m rms about its mean in steady state |\n"
        "| Reading delay | p50 400 us, p99 900 us, max 1500 us |\n"
        "| Action delay | p50 - us, p99 - us, max - us |\n"
        "| Lateness | p50 - us, p99 - us, max - us |\n"
        "| Computing | p50 20 us, p99 30 us, max 45 us |\n"
        "| Dropouts | 10 (5.00 %): 3 lost, 2 late, 1 stale, 4 missed |\n"
        "| Lost in a row | 3 readings, commands not measured |\n"
    )


def rows_of_page(**changes: Any) -> list[str]:
    """Of the table of figures."""
    two = ReviewPlan((AxisPlan("left", 1.0), AxisPlan("right", 1.0)))
    page = verdict_markdown(replace(PLAN, review=two), replace(summary_with(), **changes))
    table = page.split("| figure | value |\n|:--|:--|\n")[1]
    assert table.endswith("\n")
    return table.splitlines()


def test_dropouts_are_a_share_of_the_readings_of_all_axes() -> None:
    rows = rows_of_page(cycles=200, dropouts=DropoutCounts(3, 2, 1, 4))
    assert "| Dropouts | 10 (2.50 %): 3 lost, 2 late, 1 stale, 4 missed |" in rows
    none = rows_of_page(cycles=0, dropouts=DropoutCounts(0, 0, 0, 0))
    assert "| Dropouts | 0: 0 lost, 0 late, 0 stale, 0 missed |" in none


def test_a_torque_that_swings_is_told_where_it_was_measured() -> None:
    assert "| Torque | 0.1234 N m rms about its mean in steady state |" in rows_of_page(torque_rms_nm=0.1234)
    assert not any("about its mean" in row for row in rows_of_page(torque_rms_nm=None))


def test_a_long_text_goes_on_in_the_next_row() -> None:
    fault = "frames.arrow is incomplete: " + "no space left on the device | " * 3
    rows = [row for row in rows_of_page(recording_faults=(fault, "short", "")) if row not in rows_of_page()]
    cells = [row[2:-2].partition(" | ")[::2] for row in rows]
    assert [title for title, _ in cells] == ["Recording lacks", "", "", "Recording lacks", "Recording lacks"]
    assert " ".join(text for _, text in cells[:3]) == fault.replace("|", "/").strip()
    assert all(len(text) <= 52 for _, text in cells)
    assert [text for _, text in cells[3:]] == ["short", ""]


@pytest.mark.parametrize(
    ("check", "row"),
    [
        (
            Check("delay_p99_us_max", 901.23, 900.0, LimitResult.BROKEN, "left", 1_234_567_890),
            "| delay of readings, p99 [us] | 901.2 | 900 | **BROKEN** | left at 1.235 s |",
        ),
        (
            Check("delay_p99_us_max", 0.1, 900.5, LimitResult.KEPT),
            "| delay of readings, p99 [us] | 0.1 | 900.5 | kept |  |",
        ),
    ],
)
def test_each_limit_has_a_row_with_its_worst_place(check: Check, row: str) -> None:
    verdict = replace(summary_with().verdict, limits=(check,))
    page = verdict_markdown(PLAN, replace(summary_with(), verdict=verdict))
    assert f"| limit | value | at most | | worst |\n|:--|--:|--:|:--|:--|\n{row}\n\n" in page
    bare = verdict_markdown(PLAN, replace(summary_with(), verdict=replace(verdict, limits=())))
    assert "| limit |" not in bare


CERTIFICATE: Final = {
    "action_delay_us": {"certified": 1000.0, "seen": 912.345},
    "losses_together": {"certified": None, "seen": 2},
    "gain_rad_s_nm": {"certified": 8.0, "seen": 6.0, "seen_at_most": 7.5},
    "current_bandwidth_hz": {"certified": None, "drive": 1000.0},
}


def test_certificates_are_told_beside_what_was_seen() -> None:
    page = verdict_markdown(PLAN, replace(summary_with(), certificates={"axis1": CERTIFICATE}))
    table = (
        "| certificate | certified | seen |\n|:--|--:|--:|\n"
        "| delay to actuation [us] | 1000 | 912.3 |\n"
        "| lost in a row, together | not known | 2 |\n"
        "| gain [rad/s per N m] | 8 | 6 to 7.5 |\n\n"
        "| figure | value |\n"
    )
    assert table in page
    assert "| certificate |" not in verdict_markdown(PLAN, summary_with())


@pytest.mark.parametrize(
    ("certified", "told"),
    [((100.0, 2000.0), "100 to 2000"), ((500.0, 500.0), "500")],
)
def test_of_several_axes_each_certificate_has_its_name(certified: tuple[float, float], told: str) -> None:
    loop = {"certified": certified, "drive": None}
    both = {"left": CERTIFICATE, "right": {**CERTIFICATE, "current_bandwidth_hz": loop}}
    rows = [
        line
        for line in verdict_markdown(PLAN, replace(summary_with(), certificates=both)).splitlines()
        if line.startswith(("| left", "| right"))
    ]
    seen = [" delay to actuation [us] | 1000 | 912.3 |", " lost in a row, together | not known | 2 |"]
    seen.append(" gain [rad/s per N m] | 8 | 6 to 7.5 |")
    assert rows == [
        *[f"| left:{row}" for row in seen],
        *[f"| right:{row}" for row in seen],
        f"| right: current loop [Hz] | {told} | not known (drive) |",
    ]


def test_a_load_machine_s_steps_are_told_asked_and_measured() -> None:
    steps = [{"asked_nm": 0.5, "measured_nm": 0.49876}, {"asked_nm": -1.0, "measured_nm": None}]
    machine = {"identity": "ACME 1", "readings": 12, "late": 1, "spoilt": 2, "steps": steps}
    rows = [row for row in rows_of_page(load_machine=machine) if row not in rows_of_page()]
    assert rows == [
        "| Load machine | ACME 1: 0.5 N m asked, 0.4988 measured; -1 N m |",
        "|  | asked, - measured; 12 readings, 1 late, 2 spoilt |",
    ]


def test_times_and_shares_that_nobody_measured_are_told_so() -> None:
    nothing = Percentiles(None, None, None)
    rows = rows_of_page(reading_delay_us=nothing, bus_load_percent=None, realtime_factor=38.25)
    assert "| Reading delay | p50 - us, p99 - us, max - us |" in rows
    assert "| Bus load | not measured |" in rows
    assert "| Pace | 38.25 times real time |" in rows
