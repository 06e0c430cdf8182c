"""What the oracle calls open to all is what every way to place the readings, one by one, leaves open."""

from itertools import combinations, pairwise
from random import Random

import pytest

from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.virtual_bus.frame import Frame
from tests.draws import few_of
from tests.truth.oracle import ALIKE_PARTS, ODDS, undecidable
from tests.truth.taps import Field, Heard, PdoLayout
from tests.truth.truth import AxisTruth, Reading, SyncTruth

PERIOD = Duration(NS_PER_MS)
LAYOUT = PdoLayout((), {}, 0x201, False, Field(0x201, 0, 2))


def truth_of(delays: list[int | None], spacing: int = PERIOD) -> AxisTruth:
    """SYNCs at equal distances, each with the delay of its reading, or none."""
    syncs, readings = [], 0
    for number, delay in enumerate(delays):
        at, reading = Instant(number * spacing), None
        if delay is not None:
            reading = Reading(Instant(at + delay), readings, Heard(at, Frame(0x080), (), at))
            readings += 1
        syncs.append(SyncTruth(at, at, reading, False))
    return AxisTruth(LAYOUT, tuple(syncs), {}, {}, (), {})


def drawn(syncs: int, spread: float, lost: float, seed: int) -> list[int | None]:
    """Delays that are evenly spread over so many periods, in order."""
    draw = Random(seed)
    came = [number * PERIOD + round(draw.random() * spread * PERIOD) for number in range(syncs)]
    for number, (earlier, later) in enumerate(pairwise(came.copy()), start=1):
        came[number] = max(came[number], max(came[number - 1], earlier, later))
    return [None if draw.random() < lost else at - number * PERIOD for number, at in enumerate(came)]


def open_by_trial(delays: list[int | None]) -> set[int]:
    """The same by every way to place the readings on SYNCs, in order."""
    own = [number for number, delay in enumerate(delays) if delay is not None]
    known = [delay for delay in delays if delay is not None]
    came_at = [number * PERIOD + delay for number, delay in zip(own, known, strict=True)]
    lost = (len(delays) - len(own) + 1) / (len(delays) + 2)
    total, right = 0.0, [0.0] * len(delays)
    for placed in combinations(range(len(delays)), len(own)):
        weight = 1.0
        for number, at in zip(placed, came_at, strict=True):
            delay = at - number * PERIOD
            weight *= sum(abs(delay - other) <= PERIOD // ALIKE_PARTS for other in known)
        weight *= lost ** (placed[-1] - placed[0] + 1 - len(own))
        total += weight
        reading_of = dict(zip(placed, range(len(own)), strict=True))
        for number in range(len(delays)):
            true = own.index(number) if number in own else None
            right[number] += weight * (reading_of.get(number) == true)
    return {number * PERIOD for number, each in enumerate(right) if each / total < 1.0 - 1.0 / ODDS}


@pytest.mark.parametrize("seed", few_of(range(12), 4))
def test_forward_and_backward_sums_are_those_over_every_way(seed: int) -> None:
    delays = drawn(9, 2.5, 0.3, seed)
    assert undecidable(truth_of(delays), PERIOD) == open_by_trial(delays)


def test_delays_below_a_period_leave_nothing_open_and_wide_ones_do() -> None:
    narrow, wide = drawn(400, 0.8, 0.1, 1), drawn(400, 3.0, 0.1, 1)
    assert undecidable(truth_of(narrow), PERIOD) == set()
    assert len(undecidable(truth_of(wide), PERIOD)) > 80
