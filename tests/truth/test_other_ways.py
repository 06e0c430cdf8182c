"""Rows with another explanation are those that some way to place the readings, one by one, explains so."""

from itertools import permutations
from random import Random

import pytest

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.frame import Frame
from tests.draws import few_of
from tests.truth.other_ways import explained_otherwise
from tests.truth.taps import Heard
from tests.truth.test_oracle import LAYOUT, PERIOD, drawn
from tests.truth.truth import AxisTruth, Reading, SyncTruth


def truth_of(delays: list[int | None]) -> AxisTruth:
    """SYNCs at equal distances, each with the delay of its reading, or none."""
    syncs, newest = [], -1
    for number, delay in reversed(list(enumerate(delays))):
        at, reading = Instant(number * PERIOD), None
        if delay is not None:
            reading = Reading(Instant(at + delay), number, Heard(at, Frame(0x080), (), at))
        overtaken = reading is not None and 0 <= newest < reading.received_at
        syncs.append(SyncTruth(at, at, reading, overtaken))
        if reading is not None:
            newest = reading.received_at if newest < 0 else min(newest, reading.received_at)
    return AxisTruth(LAYOUT, tuple(reversed(syncs)), {}, {}, (), {})


def otherwise_by_trial(delays: list[int | None], *, in_order: bool) -> set[int]:
    """The same by every way to place the readings."""
    own = [number for number, delay in enumerate(delays) if delay is not None]
    known = [delay for delay in delays if delay is not None]
    came_at = [number * PERIOD + delay for number, delay in zip(own, known, strict=True)]
    found = set()
    for placed in permutations(range(len(delays)), len(own)):
        if in_order and list(placed) != sorted(placed):
            continue
        ways = [at - number * PERIOD for number, at in zip(placed, came_at, strict=True)]
        if min(ways) >= min(known) and max(ways) <= max(known):
            moved = {place for pair in zip(own, placed, strict=True) if pair[0] != pair[1] for place in pair}
            found |= {place * PERIOD for place in moved}
    return found


@pytest.mark.parametrize("seed", few_of(range(12), 4))
def test_in_order_all_other_ways_are_found(seed: int) -> None:
    delays = drawn(8, 1.6, 0.3, seed)
    assert explained_otherwise(truth_of(delays)) == otherwise_by_trial(delays, in_order=True)


@pytest.mark.parametrize("seed", few_of(range(12), 4))
def test_where_readings_overtake_others_all_other_ways_are_found(seed: int) -> None:
    draw = Random(seed)
    delays = [None if draw.random() < 0.3 else round(draw.random() * 1.8 * PERIOD) for _ in range(7)]
    truth = truth_of(delays)
    overtaken = any(sync.overtaken for sync in truth.syncs)
    assert explained_otherwise(truth) == otherwise_by_trial(delays, in_order=not overtaken)


def test_delays_that_spread_over_less_than_a_period_have_no_other_way() -> None:
    assert explained_otherwise(truth_of(drawn(400, 0.9, 0.1, 1))) == set()
    assert len(explained_otherwise(truth_of(drawn(400, 1.5, 0.1, 1)))) > 40
