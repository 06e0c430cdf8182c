"""The period of SYNCs as somebody hears them: late, lost, from a producer that stood still."""

import random

import pytest

from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.hil.loop.pace import CALIBRATION_SPACINGS, PERIOD_ERROR_MAX
from servobench.hil.loop.sync_period import period_of
from tests.draws import few_of


def heard(
    draw: random.Random, period_us: float, jitter_us: float, loss: float, stall: float
) -> list[Instant]:
    """What comes of a producer's grid: each SYNC late by up to ``jitter_us``, lost with ``loss``, and with
    ``stall`` late by some periods, whose SYNCs it then leaves out."""
    at_us, came = 1e6 * draw.random(), list[Instant]()
    while len(came) <= CALIBRATION_SPACINGS:
        at_us += period_us
        late_us = draw.uniform(0.0, jitter_us)
        if draw.random() < stall:
            late_us += period_us * draw.uniform(1.0, 6.0)
        if draw.random() >= loss:
            came.append(Instant(round((at_us + late_us) * NS_PER_US)))
        at_us += period_us * (late_us // period_us)
    return came


@pytest.mark.long
@pytest.mark.parametrize("expected_us", [250, 1000, 1003, 10_000])
def test_the_period_is_found_whatever_befalls_the_syncs(expected_us: int) -> None:
    draw = random.Random(expected_us)
    for _ in few_of(range(100), 30):
        true_us = expected_us * draw.uniform(0.999, 1.001)
        jitter_us, loss = draw.uniform(0.0, 0.45) * expected_us, draw.choice([0.0, 0.05, 0.2])
        found = period_of(heard(draw, true_us, jitter_us, loss, 0.0), Duration(expected_us * NS_PER_US))
        assert abs(found / NS_PER_US - true_us) < PERIOD_ERROR_MAX * expected_us


def test_a_producer_that_stood_still_at_times_has_its_period_all_the_same() -> None:
    draw = random.Random(1)
    for _ in few_of(range(60), 20):
        found = period_of(heard(draw, 1000.0, 200.0, 0.02, 0.1), Duration(1000 * NS_PER_US))
        assert abs(found / NS_PER_US - 1000.0) < PERIOD_ERROR_MAX * 1000.0


@pytest.mark.long
@pytest.mark.parametrize("true_us", [500, 800, 976, 1024, 1100, 1500, 2000, 3000, 10_000])
def test_another_period_is_seen(true_us: int) -> None:
    draw = random.Random(true_us)
    for _ in few_of(range(60), 20):
        found = period_of(heard(draw, true_us, 100.0, 0.05, 0.0), Duration(1000 * NS_PER_US))
        assert abs(found / NS_PER_US - 1000.0) > PERIOD_ERROR_MAX * 1000.0
