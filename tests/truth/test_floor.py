"""The floor of doubt is what every way to place the readings, one by one, leaves of it."""

from itertools import permutations
from random import Random

import pytest

from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.virtual_bus.frame import Frame
from tests.draws import few_of
from tests.truth.floor import ALIKE_PARTS, errors_of, least_doubt
from tests.truth.taps import Field, Heard, PdoLayout
from tests.truth.truth import AxisTruth, Reading, SyncTruth

PERIOD = Duration(NS_PER_MS)
LAYOUT = PdoLayout((), {}, 0x201, False, Field(0x201, 0, 2))


def truth_of(delays: list[int | None]) -> AxisTruth:
    """SYNCs at equal distances, each with the delay of its reading, or none; frames overtake each other."""
    came = [None if delay is None else Instant(place * PERIOD + delay) for place, delay in enumerate(delays)]
    syncs = []
    for place, at in enumerate(came):
        end = Instant(place * PERIOD)
        reading = None if at is None else Reading(at, place, Heard(end, Frame(0x080), (), end))
        later = [other for other in came[place + 1 :] if other is not None]
        syncs.append(SyncTruth(end, end, reading, at is not None and min(later, default=at) < at))
    return AxisTruth(LAYOUT, tuple(syncs), {}, {}, (), {})


def by_trial(delays: list[int | None]) -> dict[int, float]:
    """The same by every way to place the readings on SYNCs, in any order."""
    known = [delay for delay in delays if delay is not None]
    came = sorted(place * PERIOD + delay for place, delay in enumerate(delays) if delay is not None)
    lost = (len(delays) - len(known) + 1) / (len(delays) + 2)
    shares: dict[tuple[int, int], float] = {}
    total = 0.0
    for places in permutations(range(len(delays)), len(came)):
        weight = (1.0 - lost) ** len(came) * lost ** (len(delays) - len(came))
        for place, at in zip(places, came, strict=True):
            delay = at - place * PERIOD
            alike = sum(abs(delay - other) <= PERIOD // ALIKE_PARTS for other in known)
            weight *= alike if delay >= 0 else 0
        total += weight
        for reading, place in enumerate(places):
            shares[place, reading] = shares.get((place, reading), 0.0) + weight
    errors = {}
    for place in range(len(delays)):
        own = [shares.get((place, reading), 0.0) / total for reading in range(len(came))]
        errors[place * PERIOD] = 1.0 - max(*own, 1.0 - sum(own))
    return errors


@pytest.mark.parametrize("seed", few_of(range(8), 3))
def test_sums_over_sets_of_syncs_are_those_over_every_way(seed: int) -> None:
    draw = Random(seed)
    delays = [
        None if draw.random() < 0.2 else round(draw.choice((0.3, 1.3, 1.31, 2.3)) * PERIOD) for _ in range(7)
    ]
    delays[:2] = [round(1.5 * PERIOD), round(0.3 * PERIOD)]  # the second one overtakes the first
    assert errors_of(truth_of(delays), PERIOD) == pytest.approx(by_trial(delays), abs=1e-9)


def test_the_likeliest_wrong_are_left_in_doubt() -> None:
    assert least_doubt([0.0] * 8 + [0.1, 0.4], 100) == 1  # of ten rows, a tenth may be wrong
    assert least_doubt([0.0] * 8 + [0.1, 0.4], 1000) == 2
    assert least_doubt([0.0] * 10) == 0
