"""Drives without stamps: frames held up or later, and SYNCs of others, all held against the taps."""

import pytest

from tests.truth.plans import Plan
from tests.truth.runner import run_plan

CYCLES = 600
IN = 'direction = "drive_to_host"'
HELD = f"reorder = [{{probability = 0.01, held_us = 1500, {IN}}}]"
LATER = f"delay = [{{delay_us = 1500, {IN}}}]"
GATEWAY = f"delay = [{{delay_us = 1300, from_s = 0.3, {IN}}}]"
LOSS = f"loss = [{{probability = 0.02, {IN}}}]"


@pytest.mark.parametrize(
    "plan",
    [
        Plan("1 % held up", HELD),
        Plan("1.5 periods", LATER),
        Plan("1.5 periods, loss", f"{LATER}\n{LOSS}"),
        Plan("gateway", GATEWAY),
        Plan("kernel's SYNCs, loss", LOSS, sync="kernel"),
        Plan("another's SYNCs, 1.5 periods", LATER, sync="foreign", producer_jitter_us=50),
    ],
    ids=lambda plan: plan.name,
)
def test_without_stamps_few_rows_are_uncertain_and_none_is_wrong(plan: Plan) -> None:
    outcome = run_plan(
        Plan(
            plan.name,
            plan.faults,
            stamps=False,
            deadline_us=5000,
            sync=plan.sync,
            producer_jitter_us=plan.producer_jitter_us,
        ),
        CYCLES,
    )
    readings = outcome.readings
    assert not outcome.ended_by
    assert (readings.rows, readings.wrong, readings.bound_broken) == (CYCLES, 0, 0)
    assert readings.uncertain < 0.05 * CYCLES
