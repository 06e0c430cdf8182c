"""Position and speed of one SYNC in one TPDO, beside the encoder's own count at every tick of the drive."""

import math
from typing import Any, Final

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S
from tests.shaft_run import run_watched
from tests.unit.hil.test_config import load, tables

COUNTS, INNER_HZ = 4096, 16_000
FILTER_SHARE: Final = 1.0 / (1.0 + INNER_HZ / (math.tau * 500.0))
"""Of the newest difference of counts in 606Ch."""


def bench(**drive: Any) -> dict[str, Any]:
    raw = tables()
    raw["bench"]["duration_s"] = 0.6
    raw["drive"]["axis1"] |= drive
    raw["drive"]["axis1"]["simulation"] = {"encoder_counts_per_revolution": COUNTS}
    raw["reference"] = {"axis1": [{"at_s": 0.0, "kind": "ramp", "speed_rpm": 900.0, "over_s": 0.1}]}
    raw.pop("load", None)
    raw.pop("faults", None)
    return raw


def test_a_reading_has_the_count_of_its_own_sync() -> None:
    run = run_watched(load(bench(count_with_speed=True)), 10.0, 0.0)
    rows = run.rows[run.rows["fate"] == 0]
    assert len(rows) > 590
    assert (rows["position_told_at"] == rows["received_at"]).all()
    counts = rows["position_rad"] * COUNTS / math.tau
    assert counts == pytest.approx(np.round(counts), abs=1e-6)
    # The angle by the shaft's own speed at every tick: each count is the whole part of it.
    speeds, share = run.speeds_rad_s, COUNTS / math.tau / INNER_HZ
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]))]) * share
    ticks = np.searchsorted(run.times_s, rows["sampled_at"] / NS_PER_S, side="right") - 1
    rounding = counts - turned[ticks]
    assert np.ptp(rounding) < 1.0
    # What 606Ch leaves of 6064h is an exponential mean of past counts, with a smaller rounding of its own.
    means = np.zeros(len(turned))
    for tick in range(1, len(turned)):
        means[tick] = means[tick - 1] + FILTER_SHARE * (turned[tick - 1] - means[tick - 1])
    past = counts - rows["velocity_rad_s"] / FILTER_SHARE * share - means[ticks]
    steady = rows["sampled_at"] > rows["sampled_at"][0] + 0.2 * NS_PER_S
    assert np.std(rounding[steady]) == pytest.approx(1.0 / math.sqrt(12.0), rel=0.1)
    assert np.std(past[steady]) < 0.4 * np.std(rounding[steady])


def test_without_it_a_count_is_of_the_sync_before() -> None:
    run = run_watched(load(bench()), 10.0, 0.0)
    rows = run.rows[run.rows["fate"] == 0]
    assert (rows["position_told_at"] < rows["received_at"]).all()


def test_events_need_the_stamp_that_the_count_displaces() -> None:
    raw = bench(count_with_speed=True)
    raw["loop"]["command_readback"] = "event"
    with pytest.raises(BadInput, match=r"loop\.command_readback.*6064h takes its room on axis1"):
        load(raw)
