"""Commands in three fates, by a drive that tells them at SYNCs, beside the tap at that drive.

No command is lost in these plans, where they act on arrival. Intervals are judged without a tolerance.
"""

import pytest

from servobench.drivers.timebase import Duration
from tests.truth.command_judge import CommandJudgement, judge_commands
from tests.truth.plans import Plan
from tests.truth.rows import READING_IS_A_SET, told_by
from tests.truth.runner import bench_config
from tests.truth.tapped_run import run_with_taps
from tests.truth.truth import axis_truth

CYCLES = 1_300
BEHIND = 'direction = "host_to_drive", side = "drive", frames = ["pdo"]'
IN = 'direction = "drive_to_host"'
LATE_BEHIND = f"delay = [{{delay_min_us = 0, delay_max_us = 1500, {BEHIND}}}]"
LOST_BEHIND = f"loss = [{{probability = 0.1, {BEHIND}}}]"
OVERTAKING = f"delay = [{{delay_min_us = 0, delay_max_us = 1500, {IN}, reorder = true}}]"
LATE = f"delay = [{{delay_min_us = 0, delay_max_us = 1500, {IN}}}]"
TWICE = f"duplicate = [{{probability = 0.3, later_us = 1000, {IN}}}]"


def judged(faults: str, actuation: str) -> CommandJudgement:
    config = bench_config(Plan("fates", faults, actuation=actuation, commands=True), CYCLES)
    loop = config.loop.model_copy(update={"command_readback": "sync"})
    config = config.model_copy(update={"loop": loop})
    run = run_with_taps(config)
    assert run.ended_by == ""
    truth = axis_truth(run.log, config.drive["axis1"].node, READING_IS_A_SET)
    return judge_commands(told_by(run.rows, 0, config.loop.period), truth, Duration(0))


@pytest.mark.parametrize("actuation", ["on_arrival", "on_sync"])
@pytest.mark.parametrize(
    ("faults", "acting"),
    [("", 0.95), (LATE_BEHIND, 0.7), (OVERTAKING, 0.93), (LATE, 0.95), (TWICE, 0.95), (LOST_BEHIND, 0.84)],
)
def test_no_fate_is_wrong_and_every_interval_holds(faults: str, acting: float, actuation: str) -> None:
    found = judged(faults, actuation)
    assert found.handed >= CYCLES - 1
    assert (found.wrong, found.unknown, found.outside) == (0, 0, 0)
    assert found.told_acting >= acting * found.handed, "it is not silence that holds"


def test_losses_behind_the_echo_are_told_where_commands_act_at_syncs_and_bounded_where_on_arrival() -> None:
    at_syncs, on_arrival = judged(LOST_BEHIND, "on_sync"), judged(LOST_BEHIND, "on_arrival")
    assert at_syncs.told_lost >= 0.95 * at_syncs.lost > 0
    assert on_arrival.told_lost == 0 < 0.95 * on_arrival.lost <= on_arrival.told_passed
