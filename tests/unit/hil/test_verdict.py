"""The definition of a valid run: each condition alone, and which of several is told."""

import itertools
import json
import random
from dataclasses import asdict, replace

import pytest

from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.verdict import (
    CycleCount,
    DriveEnd,
    ExitStatus,
    Finding,
    LimitResult,
    RunOutcome,
    RunVerdict,
    VerdictKind,
    judge,
    not_run,
    outcome_of_status,
)
from tests.unit.hil.recording_tools import RESTING, whole_outcome

CYCLES = 200
WHOLE = whole_outcome(CYCLES)
COUNT = CycleCount(CYCLES, CYCLES, 0)
LIMITS = VerdictLimits(dropouts_percent_max=1.0)
KEPT: dict[str, float | None] = {"dropouts_percent_max": 1.0}
BROKEN: dict[str, float | None] = {"dropouts_percent_max": 1.1}
UNMEASURED: dict[str, float | None] = {"dropouts_percent_max": None}


def two_axes(other: DriveEnd) -> RunOutcome:
    return replace(WHOLE, drives=(RESTING, other))


def test_a_run_that_keeps_all_is_passed() -> None:
    verdict = judge(WHOLE, COUNT, KEPT, LIMITS)
    assert (verdict.outcome, verdict.exit_status, verdict.reason) == (VerdictKind.PASSED, 0, "")
    assert verdict.passed
    assert verdict.completed
    assert verdict.findings == ()


def test_a_run_without_limits_is_completed_and_not_passed() -> None:
    verdict = judge(WHOLE, COUNT, KEPT, VerdictLimits())
    assert (verdict.outcome.value, verdict.exit_status) == ("completed, nothing was asked", 0)
    assert not verdict.passed
    assert verdict.completed


ONE_BY_ONE = {
    "a cycle without a row": (WHOLE, CycleCount(199, 199, 0), KEPT, "", VerdictKind.CUT_SHORT),
    "a row too many": (WHOLE, CycleCount(200, 201, 0), KEPT, "", VerdictKind.CUT_SHORT),
    "one axis lacks a cycle": (two_axes(RESTING), CycleCount(199, 399, 0), KEPT, "", VerdictKind.CUT_SHORT),
    "a cycle twice, and another not at all": (WHOLE, CycleCount(99, 200, 0), KEPT, "", VerdictKind.CUT_SHORT),
    "no plan": (replace(WHOLE, cycles_planned=None), COUNT, KEPT, "", VerdictKind.CUT_SHORT),
    "no drive looked at": (replace(WHOLE, drives=()), COUNT, KEPT, "", VerdictKind.CUT_SHORT),
    "one drive not looked at": (
        two_axes(replace(RESTING, after_last_cycle=None)), CycleCount(200, 400, 0), KEPT, "",
        VerdictKind.CUT_SHORT,
    ),
    "not at rest": (
        replace(WHOLE, drives=(replace(RESTING, at_rest=False),)), COUNT, KEPT, "", VerdictKind.PEER_FAULT
    ),
    "rest not asked": (
        replace(WHOLE, drives=(replace(RESTING, at_rest=None),)), COUNT, KEPT, "", VerdictKind.PEER_FAULT
    ),
    "an EMCY": (replace(WHOLE, emergencies=("EMCY 8130h",)), COUNT, KEPT, "", VerdictKind.PEER_FAULT),
    "others": (replace(WHOLE, disturbances=("a heartbeat",)), COUNT, KEPT, "", VerdictKind.DISTURBED),
    "timing": (replace(WHOLE, distrust=("two stamps",)), COUNT, KEPT, "", VerdictKind.NOT_TRUSTWORTHY),
    "recording": (WHOLE, COUNT, KEPT, "a full disk", VerdictKind.NOT_RECORDED),
    "cut short": (replace(WHOLE, completed=False, reason="away"), COUNT, KEPT, "", VerdictKind.CUT_SHORT),
    "a signal": (
        replace(WHOLE, completed=False, reason="SIGINT", cause=VerdictKind.INTERRUPTED), COUNT, KEPT, "",
        VerdictKind.INTERRUPTED,
    ),
    "an error": (
        replace(WHOLE, completed=False, reason="lost", cause=VerdictKind.PEER_FAULT), COUNT, KEPT, "",
        VerdictKind.PEER_FAULT,
    ),
    "a limit broken": (WHOLE, COUNT, BROKEN, "", VerdictKind.NOT_PASSED),
    "a limit not measured": (WHOLE, COUNT, UNMEASURED, "", VerdictKind.NOT_MEASURED),
}  # fmt: skip


_PASSED, _COMPLETED = VerdictKind.PASSED_DISTURBED, VerdictKind.COMPLETED_DISTURBED
"""What a run comes to of which nothing was found but others; without limits the second."""


@pytest.mark.parametrize("what", ONE_BY_ONE)
def test_each_condition_alone_keeps_a_run_from_passing(what: str) -> None:
    outcome, count, values, lacks, expected = ONE_BY_ONE[what]
    verdict = judge(outcome, count, values, LIMITS, lacks)
    assert verdict.outcome is (_PASSED if expected is VerdictKind.DISTURBED else expected)
    assert verdict.exit_status == expected.exit_status != 0
    assert not verdict.passed
    assert verdict.reason
    assert len(verdict.findings) == 1
    assert from_plain(RunVerdict, json.loads(json.dumps(asdict(verdict)))) == verdict


OF_LIMITS = (VerdictKind.NOT_PASSED, VerdictKind.NOT_MEASURED)


@pytest.mark.parametrize("what", [name for name, case in ONE_BY_ONE.items() if case[4] not in OF_LIMITS])
def test_nor_does_it_pass_for_a_completed_run_of_which_nothing_was_asked(what: str) -> None:
    outcome, count, values, lacks, expected = ONE_BY_ONE[what]
    verdict = judge(outcome, count, values, VerdictLimits(), lacks)
    assert verdict.outcome is (_COMPLETED if expected is VerdictKind.DISTURBED else expected)


def test_missed_cycles_are_accounted_for_where_limits_judge_them_and_not_without() -> None:
    missed = CycleCount(CYCLES, CYCLES, 1)
    assert judge(WHOLE, missed, KEPT, LIMITS).passed
    verdict = judge(WHOLE, missed, KEPT, VerdictLimits())
    assert (verdict.outcome, verdict.exit_status) == (VerdictKind.NOT_MEASURED, 6)
    assert "1 cycles went without SYNC" in verdict.reason


@pytest.mark.parametrize("values", [KEPT, BROKEN, UNMEASURED])
def test_of_a_run_that_was_cut_short_no_limit_was_measured(values: dict[str, float | None]) -> None:
    (check,) = judge(replace(WHOLE, completed=False, reason="away"), COUNT, values, LIMITS).limits
    assert check.result is LimitResult.NOT_MEASURED
    assert check.value == values["dropouts_percent_max"], "that of the part is shown"


STATUSES_BY_GRAVITY = (70, 3, 130, 4, 5, 6, 1)
"""Issue 12: where several hold, the first of these."""


def test_the_order_of_gravity_is_that_of_the_statuses() -> None:
    told = [outcome.exit_status for outcome in VerdictKind if outcome is not VerdictKind.BAD_INPUT]
    disturbed = 4, 0
    assert [status for status, _ in itertools.groupby(told)] == [*STATUSES_BY_GRAVITY, *disturbed]
    assert {status.value for status in ExitStatus} == {0, 1, 2, 3, 4, 5, 6, 7, 70, 130}


def found_with(status: int, outcome: RunOutcome) -> RunOutcome:
    """``outcome`` with what alone gives ``status``; 70 and 130 exclude each other as ends of a run."""
    causes = {70: VerdictKind.DEFECT, 130: VerdictKind.INTERRUPTED, 6: VerdictKind.CUT_SHORT}
    if status in causes and outcome.completed:
        return replace(outcome, completed=False, reason="ended", cause=causes[status])
    if status == 3:
        return replace(outcome, emergencies=("EMCY 8130h",))
    return replace(outcome, distrust=("two stamps",)) if status == 4 else outcome


@pytest.mark.parametrize("pair", [*itertools.combinations(STATUSES_BY_GRAVITY, 2)])
def test_of_two_the_graver_is_told(pair: tuple[int, int]) -> None:
    outcome = WHOLE
    for status in pair:
        outcome = found_with(status, outcome)
    limits, values = LIMITS, BROKEN if 1 in pair else KEPT
    if pair == (6, 1):
        # of a run that was cut short no limit is measured: both in one that was not
        outcome, limits = WHOLE, replace(LIMITS, delay_p99_us_max=1.0)
    assert judge(outcome, COUNT, values, limits, "a full disk" if 5 in pair else "").exit_status == pair[0]


def test_whatever_is_found_the_gravest_is_told_and_nothing_is_dropped() -> None:
    draw = random.Random(12)
    kinds = [
        outcome for outcome in VerdictKind if outcome.exit_status and outcome not in (_PASSED, _COMPLETED)
    ]
    for _ in range(200):
        found = [Finding(draw.choice(kinds), str(number)) for number in range(draw.randint(1, 6))]
        verdict = not_run(found[0].outcome, found[0].text)
        for finding in found[1:]:
            verdict = verdict.also(finding)
        gravest = min(found, key=lambda finding: list(VerdictKind).index(finding.outcome))
        assert verdict.outcome is (
            _COMPLETED if gravest.outcome is VerdictKind.DISTURBED else gravest.outcome
        )
        assert sorted(each.text for each in verdict.findings) == sorted(each.text for each in found)
        assert not verdict.passed


def test_an_error_comes_to_what_its_status_says() -> None:
    for outcome in (
        VerdictKind.PEER_FAULT,
        VerdictKind.BAD_INPUT,
        VerdictKind.INTERRUPTED,
        VerdictKind.NOT_RECORDED,
    ):
        assert outcome_of_status(outcome.exit_status) is outcome
    assert outcome_of_status(70) is outcome_of_status(-9) is VerdictKind.DEFECT


def test_an_outcome_survives_the_way_to_the_logger() -> None:
    outcome = replace(WHOLE, cause=VerdictKind.PEER_FAULT, emergencies=("EMCY",), distrust=("two stamps",))
    there = from_plain(RunOutcome, json.loads(json.dumps(asdict(outcome))))
    assert judge(there, COUNT, KEPT, LIMITS) == judge(outcome, COUNT, KEPT, LIMITS)
    assert there.drives == outcome.drives
