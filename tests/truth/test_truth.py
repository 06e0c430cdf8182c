"""Every row of short runs is what happened, as taps outside the bench have seen it.

``python -m tests.benchmarks.bench_truth`` runs all plans, and each for longer.
"""

import pytest

from tests.truth.plans import NO_LIMIT, PLANS, SHORT, Plan
from tests.truth.runner import Outcome, run_plan

CYCLES = 1_300


@pytest.mark.parametrize("name", SHORT)
def test_what_a_run_tells_is_what_happened(name: str) -> None:
    plan = next(plan for plan in PLANS if plan.name == name)
    outcome = run_plan(plan, CYCLES)
    if outcome.skipped:
        pytest.skip(outcome.skipped)
    assert outcome.readings.rows >= CYCLES
    assert outcome.broken() == []


def test_a_delay_is_asked_for_where_one_can_be_known() -> None:
    """Jitter beyond the period, and no stamps: no row is certain, so there is no error of a delay."""
    assert Outcome(Plan("nothing is certain", decides=False, delay_us=NO_LIMIT)).broken() == []
    assert Outcome(Plan("nothing is certain")).broken() == ["delay error p99: nan us"]
