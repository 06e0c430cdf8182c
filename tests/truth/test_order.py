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
OTHER_PHASE = f'delay = [{{delay_us = 392, {IN}, side = "drive", from_s = 0.2}}]'
THERE_AND_BACK = f"""delay = [
    {{delay_min_us = 0, delay_max_us = 45, {IN}}},
    {{delay_us = 1063, {IN}, side = "drive", from_s = 0.2, until_s = 0.4}},
]"""
OFTEN_HELD = f"reorder = [{{probability = 0.05, held_min_us = 300, held_max_us = 1600, {IN}}}]"
SYNCS_LATE = """delay = [
    {delay_min_us = 0, delay_max_us = 120, direction = "host_to_drive", side = "drive", frames = ["sync"]},
]"""


@pytest.mark.parametrize(
    "plan",
    [
        Plan("1 % held up", HELD),
        Plan("1.5 periods", LATER),
        Plan("1.5 periods, loss", f"{LATER}\n{LOSS}"),
        Plan("gateway", GATEWAY),
        Plan("kernel's SYNCs, loss", LOSS, sync="kernel"),
        Plan("another's SYNCs, 1.5 periods", LATER, sync="foreign", producer_jitter_us=50),
        Plan("kernel's SYNCs, another phase, loss", f"{OTHER_PHASE}\n{LOSS}", sync="kernel"),
        Plan("kernel's SYNCs, late at the drive, loss", f"{SYNCS_LATE}\n{LOSS}", sync="kernel"),
    ],
    ids=lambda plan: plan.name,
)
def test_without_stamps_few_rows_are_uncertain_and_none_is_wrong(plan: Plan) -> None:
    _judge(plan, 0.05)


@pytest.mark.parametrize(
    ("plan", "unsure"),
    [
        (Plan("a gateway there and back", THERE_AND_BACK), 0.1),
        (Plan("5 % held up, loss", f"{OFTEN_HELD}\n{LOSS}"), 0.2),
    ],
    ids=lambda plan: plan.name if isinstance(plan, Plan) else "",
)
def test_what_may_be_one_or_the_other_is_in_doubt_and_no_more(plan: Plan, unsure: float) -> None:
    """A reading that fits two SYNCs."""
    _judge(plan, unsure)


def _judge(plan: Plan, unsure: float) -> None:
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
    assert readings.uncertain < unsure * CYCLES
