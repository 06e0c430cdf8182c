"""Which figure each limit is held against, what is said of gaps, and the lines of certificates and timing."""

from dataclasses import fields, replace
from typing import Any

import pytest

from servobench.hil.verdict.figures import (
    NO_TIMES,
    DropoutCounts,
    Figures,
    Percentiles,
    PositionError,
    SpeedError,
    StepResponse,
    WorstPlace,
)
from servobench.hil.verdict.metrics import VerdictLimits, metric_title
from servobench.hil.verdict.summary import summarise
from servobench.hil.verdict.summary_text import certificate_lines, certificate_rows, timing_lines
from servobench.hil.verdict.verdict import (
    Check,
    CycleCount,
    Demand,
    DriveEnd,
    ExitStatus,
    Finding,
    LimitResult,
    RunOutcome,
    VerdictKind,
    judge,
    outcome_of_status,
    verdict_title,
)
from tests.unit.hil.recording_tools import RESTING
from tests.unit.hil.test_summary import timing

FIGURES = Figures(
    cycles=100,
    rows=200,
    dense=100,
    dropouts=DropoutCounts(lost=8, late=4, stale=2, missed=6),
    reading_delay_us=Percentiles(101.0, 102.0, 103.0),
    action_delay_us=NO_TIMES,
    action_delay_least_us=NO_TIMES,
    speed_error=SpeedError(111.0, 112.0, 113.0, 114.0),
    lateness_us=Percentiles(121.0, 122.0, 123.0),
    compute_us=Percentiles(131.0, 132.0, 133.0),
    digest="abc",
    torque_rms_nm=141.0,
    position_error=PositionError(151.0, 152.0, 153.0),
    step_response=StepResponse(161.0, 162.0, 163.0),
    reading_losses_in_a_row=17,
    worst={"delay_p99_us_max": WorstPlace("left", 5), "dropouts_percent_max": WorstPlace("right")},
)
HELD = {
    "speed_error_peak_percent_max": 112.0,
    "after_load_percent_max": 114.0,
    "speed_error_rms_rad_s_max": 113.0,
    "dropouts_percent_max": 10.0,
    "delay_p99_us_max": 102.0,
    "bus_load_percent_max": 55.0,
    "missed_percent_max": 3.0,
    "lateness_us_max": 123.0,
    "compute_us_max": 133.0,
    "torque_rms_nm_max": 141.0,
    "settling_time_ms_max": 161.0,
    "overshoot_percent_max": 162.0,
    "recovery_time_ms_max": 163.0,
    "losses_in_a_row_max": 17.0,
    "position_error_peak_rad_max": 151.0,
    "position_error_rms_rad_max": 152.0,
    "following_error_peak_rad_max": 153.0,
}
OUTCOME = RunOutcome(bus_load_percent=55.0, cycles_planned=100, drives=(RESTING, replace(RESTING, name="b")))


def test_every_limit_has_its_figure() -> None:
    lacking = sorted({each.name for each in fields(VerdictLimits)} ^ set(HELD))
    assert not lacking, f"{lacking}: give HELD the number of FIGURES or OUTCOME it is held to"
    assert len({metric_title(key) for key in HELD}) == len(HELD)


@pytest.mark.parametrize("metric", HELD)
@pytest.mark.parametrize(("above", "result"), [(0.0, LimitResult.KEPT), (-0.001, LimitResult.BROKEN)])
def test_a_limit_is_kept_up_to_its_value(metric: str, above: float, result: LimitResult) -> None:
    value = HELD[metric]
    limit = value + above
    verdict = summarise(FIGURES, OUTCOME, VerdictLimits(**{metric: limit}), "", 7).verdict
    place = FIGURES.worst.get(metric, WorstPlace())
    assert verdict.limits == (Check(metric, value, limit, result, place.axis, place.at_ns),)
    told = () if result is LimitResult.KEPT else (f"{metric} = {limit:g}, found {value:.4g}",)
    assert tuple(finding.text for finding in verdict.findings) == told
    assert verdict.passed is (result is LimitResult.KEPT)


def test_demands_of_a_certificate_are_held_as_limits_are() -> None:
    demands = [
        Demand("certified_action_delay_us", "left", 5.0, 5.0),
        Demand("certified_losses_together", "", None, 2.0),
    ]
    verdict = judge(OUTCOME, CycleCount(100, 200, 0), {}, VerdictLimits(), demands=demands)
    assert verdict.limits == (
        Check("certified_action_delay_us", 5.0, 5.0, LimitResult.KEPT, "left"),
        Check("certified_losses_together", None, 2.0, LimitResult.NOT_MEASURED),
    )
    text = "certified_losses_together = 2, and nothing was measured"
    assert verdict.findings == (Finding(VerdictKind.NOT_MEASURED, text),)
    assert (verdict.reason, verdict_title(verdict)) == (text, "NOT MEASURED")


@pytest.mark.parametrize(
    ("changes", "count", "texts"),
    [
        ({"drives": ()}, CycleCount(100, 200, 0), ["no drive was looked at after the last cycle"]),
        ({"cycles_planned": None}, CycleCount(100, 200, 0), ["how many cycles were planned is not known"]),
        ({}, CycleCount(100, 199, 0), ["199 cycles are accounted for, of 200 that were planned"]),
        ({}, CycleCount(99, 200, 0), ["rows are missing or double behind cycle 99"]),
        (
            {"drives": (replace(RESTING, after_last_cycle=None), replace(RESTING, name="b"))},
            CycleCount(100, 200, 0),
            [f"{RESTING.name} was not looked at after the last cycle"],
        ),
        ({"completed": False, "reason": "why"}, CycleCount(1, 2, 0), ["why"]),
    ],
)
def test_what_was_not_run_is_told(changes: dict[str, Any], count: CycleCount, texts: list[str]) -> None:
    verdict = judge(replace(OUTCOME, **changes), count, {}, VerdictLimits(dropouts_percent_max=1.0))
    assert verdict.of(VerdictKind.CUT_SHORT) == tuple(texts)
    assert (verdict.outcome, verdict.exit_status) == (VerdictKind.CUT_SHORT, ExitStatus.INCOMPLETE)
    assert (verdict.completed, verdict.reason) == (False, "; ".join(texts))
    assert [check.result for check in verdict.limits] == [LimitResult.NOT_MEASURED]


def test_what_speaks_against_a_run_is_told_the_gravest_first() -> None:
    drives = (
        DriveEnd("a", "operation enabled", "switch on disabled", at_rest=False, evidence="3 rad/s"),
        DriveEnd("b", "operation enabled", "switch on disabled", at_rest=None),
    )
    outcome = replace(
        OUTCOME, drives=(replace(drives[0], unwatched="1016h is 0"), drives[1]), emergencies=("b: 8130h",),
        distrust=("SYNCs early",),
    )  # fmt: skip
    verdict = judge(outcome, CycleCount(100, 200, 3), {}, VerdictLimits(), "the ring was full")
    assert [(finding.outcome, finding.text) for finding in verdict.findings] == [
        (VerdictKind.PEER_FAULT, "a is not confirmed at rest: 3 rad/s"),
        (VerdictKind.PEER_FAULT, "a: 1016h is 0"),
        (VerdictKind.PEER_FAULT, "b is not confirmed at rest"),
        (VerdictKind.PEER_FAULT, "b: 8130h"),
        (VerdictKind.NOT_TRUSTWORTHY, "SYNCs early"),
        (VerdictKind.NOT_RECORDED, "the ring was full"),
        (VerdictKind.NOT_MEASURED, "3 cycles went without SYNC, and no limit says how many may"),
    ]
    later = verdict.also(Finding(VerdictKind.DEFECT, "late"))
    assert (later.outcome, later.reason, later.exit_status) == (VerdictKind.DEFECT, "late", 70)
    stopped = replace(outcome, completed=False, reason="why", drives=drives[1:], emergencies=(), distrust=())
    assert judge(stopped, CycleCount(1, 1, 0), {}, VerdictLimits()).findings == (
        Finding(VerdictKind.CUT_SHORT, "why"),
    )


def test_the_status_of_an_error_tells_its_kind() -> None:
    kinds = {
        2: VerdictKind.BAD_INPUT,
        3: VerdictKind.PEER_FAULT,
        5: VerdictKind.NOT_RECORDED,
        6: VerdictKind.CUT_SHORT,
        130: VerdictKind.INTERRUPTED,
    }
    statuses = range(-1, 131)
    assert [outcome_of_status(each) for each in statuses] == [
        kinds.get(each, VerdictKind.DEFECT) for each in statuses
    ]


CERTIFICATE: dict[str, Any] = {
    "action_delay_us": {"certified": 800.0, "seen": 500.0, "seen_at_most": 1000.04},
    "losses_together": {"certified": 2, "seen": 3, "seen_at_most": None},
    "gain_rad_s_nm": {"certified": None, "seen": 12.34567, "seen_at_most": 12.34567},
    "current_bandwidth_hz": {"certified": (500.0, 1250.5), "drive": None},
}
SURE = CERTIFICATE | {
    "losses_together": {"certified": 2, "seen": None},
    "current_bandwidth_hz": {"certified": (800.0, 800.01), "drive": 800.0},
}
BARE = CERTIFICATE | {"current_bandwidth_hz": {"certified": None, "drive": 1.0}}


def test_what_is_certified_stands_beside_what_was_seen() -> None:
    seen = "delay to actuation [us] 800, seen 500 to 1000; lost in a row, together 2, seen 3; "
    seen += "gain [rad/s per N m] not known, seen 12.35"
    line = f"{seen}; current loop [Hz] 500 to 1250, the drive's not known"
    assert certificate_lines({"a": CERTIFICATE}) == {"Certificate": line}
    assert certificate_lines({"a": BARE, "b": CERTIFICATE}) == {
        "Certificate of a": seen, "Certificate of b": line
    }  # fmt: skip
    rows = [("delay to actuation [us]", "800", "500 to 1000"), ("lost in a row, together", "2", "not known")]
    rows += [("gain [rad/s per N m]", "not known", "12.35"), ("current loop [Hz]", "800", "800 (drive)")]
    assert certificate_rows({"a": SURE}) == rows
    both = certificate_rows({"a": SURE, "b": BARE})
    assert both[:4] == [(f"a: {words}", certified, seen) for words, certified, seen in rows]
    assert [words for words, _, _ in both[4:]] == [
        "b: delay to actuation [us]",
        "b: lost in a row, together",
        "b: gain [rad/s per N m]",
    ]
    assert (certificate_lines(None), certificate_lines({}), certificate_rows(None)) == ({}, {}, [])


@pytest.mark.parametrize(
    ("error_us", "text"),
    [(0.12345, "0.123"), (99.94, "99.9"), (100.0, "100"), (100.4, "100"), (1234.6, "1235")],
)
def test_an_accuracy_has_three_digits(error_us: float, text: str) -> None:
    assert timing_lines(timing(error_us_max=error_us, clock_steps=1))["Timing"] == (
        f"sampled +-{text} us, clock -1000.0 ppm, set once"
    )


@pytest.mark.parametrize(
    ("basis", "text"),
    [
        ("none", "no echo: the instant is that of its hand-over"),
        ("receipt", "by its echo, stamped when this process had it"),
        ("kernel", "by its echo, stamped by the kernel"),
        ("hardware", "by its echo, stamped by the adapter"),
        ("bus", "by its echo, stamped by the bus"),
    ],
)
def test_sync_is_told_by_what_its_instant_rests_on(basis: str, text: str) -> None:
    told = timing()
    told["sync"] = {"one": {"basis": basis, "surplus": 0, "crowded": 0}, "two": told["sync"]["bus"]}
    kernel = "by its echo, stamped by the kernel"
    assert timing_lines(told) == {
        "SYNC of one": text, "SYNC of two": kernel, "Timing": "sampled +-9.25 us, clock -1000.0 ppm"
    }  # fmt: skip
