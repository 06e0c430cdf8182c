"""By what steps the stamps of changes advance, told by how long after SYNCs they come."""

import random
from collections.abc import Iterable

import pytest

from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.hil.loop.drive_stamps import LatchSteps
from tests.draws import few_of

TICK_US = 62.5
MICROSECOND = Duration(NS_PER_US)


def shown(phases_us: Iterable[float]) -> LatchSteps:
    steps = LatchSteps()
    for phase_us in phases_us:
        steps.add(int(phase_us) * NS_PER_US, MICROSECOND)
    return steps


@pytest.mark.parametrize("seed", few_of(range(20), 5))
def test_changes_that_wait_for_a_tick_show_it(seed: int) -> None:
    """In whole microseconds it is 62 or 63 of them, by the tick that the SYNC is of."""
    draw = random.Random(seed)
    ticks = [(draw.randrange(2), draw.randrange(32)) for _ in range(60)]
    phases = [int(TICK_US * (first + then)) - int(TICK_US * first) for first, then in ticks]
    assert TICK_US - 2 <= shown(phases).step / NS_PER_US <= TICK_US + 1


@pytest.mark.parametrize("seed", few_of(range(20), 5))
def test_changes_at_any_time_show_that_there_is_no_tick(seed: int) -> None:
    draw = random.Random(seed)
    assert shown(draw.uniform(80, 300) for _ in range(60)).step <= 10 * NS_PER_US


def test_coarse_stamps_show_their_step() -> None:
    draw = random.Random(7)
    assert 250 <= shown(250 * draw.randrange(1, 8) for _ in range(20)).step / NS_PER_US <= 500
    assert shown([250]).step == 250 * NS_PER_US


def test_changes_that_come_with_their_sync_show_none() -> None:
    assert shown([0] * 20).step == 0


def test_syncs_at_other_distances_have_shown_that_it_is_no_longer() -> None:
    steps = shown([300])
    assert steps.step == 300 * NS_PER_US
    steps.most = 40 * NS_PER_US
    assert steps.step == 40 * NS_PER_US
