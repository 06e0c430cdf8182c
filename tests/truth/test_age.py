"""With ``stamp`` every reading acts at exactly the agreed age, as taps outside the bench have seen it."""

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_US
from tests.truth.plans import Plan
from tests.truth.runner import bench_config
from tests.truth.tapped_run import run_with_taps
from tests.truth.truth import AxisTruth, axis_truth

CYCLES = 400
AGE_ERROR_NS = 2 * NS_PER_US
JITTER = 'delay = [{delay_min_us = 0, delay_max_us = 1500, direction = "drive_to_host"}]'
CALM = 'delay = [{delay_us = 100, direction = "drive_to_host"}]'


@pytest.mark.parametrize(
    "plan",
    [
        Plan("stamp", JITTER, acts_at_age_us=3000, actuation="on_sync", drift_ppm=100),
        Plan("stamp, one period", CALM, acts_at_age_us=1000, actuation="on_sync"),
        Plan("stamp, 1003 us", JITTER, acts_at_age_us=3009, actuation="on_sync", period_us=1003),
        Plan("stamp, three axes", JITTER, acts_at_age_us=6000, actuation="on_sync", period_us=2000, axes=3),
    ],
    ids=lambda plan: plan.name,
)
def test_a_reading_acts_at_the_agreed_age(plan: Plan) -> None:
    assert plan.acts_at_age_us is not None
    agreed_ns = plan.acts_at_age_us * NS_PER_US
    config = bench_config(plan, CYCLES)
    run = run_with_taps(config)
    assert run.ended_by == ""
    for axis, name in enumerate(config.axes):
        truth = axis_truth(run.log, config.drive[name].node, reading_is_a_set=False)
        rows = run.rows[run.rows["axis"] == axis]
        sync_of = {int(row["sequence"]): truth.place_of[int(row["sync_handed_at"])] for row in rows}
        late_ns = _lateness_ns(truth)
        ages_ns = []
        for row in rows:
            command = truth.commands[int(row["command_handed_at"])]
            applied = int(row["estimate_sequence"])
            if applied and command.acts_at is not None:
                reading = truth.syncs[sync_of[applied]].reading
                assert reading is not None
                ages_ns.append(command.acts_at - reading.heard.at)
                off_ns = late_ns[command.acts_at] - late_ns[reading.heard.at]
                assert abs(ages_ns[-1] - off_ns - agreed_ns) <= AGE_ERROR_NS
        assert len(ages_ns) > CYCLES - 10
        assert np.mean(np.abs(np.array(ages_ns) - agreed_ns) <= AGE_ERROR_NS) > 0.9


def _lateness_ns(truth: AxisTruth) -> dict[int, int]:
    """By the end of each SYNC: how long it waited for other frames of the bus, which nobody can help."""
    syncs = [(sync.handed_at, sync.on_bus_at) for sync in truth.syncs if sync.on_bus_at is not None]
    least = min(on_bus_at - handed_at for handed_at, on_bus_at in syncs)
    return {on_bus_at: on_bus_at - handed_at - least for handed_at, on_bus_at in syncs}
