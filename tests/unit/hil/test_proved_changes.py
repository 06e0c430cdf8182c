"""From when on a demand that a drive stamped when it changed is placed by the map of its clock."""

import pytest

from servobench.drivers.exchange import DemandChange, Reading
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.loop.readback_tie import ProvedChanges

SETTLED = 3


def reading(stamp: int) -> Reading:
    return Reading(0.0, stamp, Instant(stamp), 0.0, Instant(0), 0.0, Instant(0), 0, Instant(0))


def change(stamp: int) -> DemandChange:
    return DemandChange(7, stamp, Instant(stamp))


def changes_after(*readings: tuple[int, bool]) -> ProvedChanges:
    """``readings``: stamp in ms, and whether the place is certain."""
    changes = ProvedChanges(SETTLED)
    for stamp, certain in readings:
        changes.reading(reading(stamp * NS_PER_MS), certain=certain)
    return changes


def test_a_change_waits_for_a_reading_that_was_stamped_later() -> None:
    changes = changes_after((1, True))
    told = change(NS_PER_MS + 1)
    assert changes.take([told], spread=False) == []
    changes.reading(reading(2 * NS_PER_MS), certain=True)
    assert changes.take([], spread=False) == [told]
    assert changes.take([], spread=False) == []


def test_a_change_by_a_clock_that_may_have_been_set_is_not_placed() -> None:
    changes = changes_after((1, True))
    assert changes.take([change(NS_PER_MS + 1)], spread=False) == []
    changes.reading(reading(9 * NS_PER_MS), certain=False)
    assert changes.take([change(9 * NS_PER_MS + 1)], spread=False) == []
    for stamp in (10, 11):
        changes.reading(reading(stamp * NS_PER_MS), certain=True)
    assert changes.take([change(2 * NS_PER_MS)], spread=False) == [], "it came late, from before the step"
    told = change(10 * NS_PER_MS + 1)
    assert changes.take([told], spread=False) == [told]


@pytest.mark.parametrize(("later", "proved"), [(SETTLED, False), (SETTLED + 1, True)])
def test_where_delays_spread_a_change_waits_until_no_reading_before_is_taken_back(
    later: int, proved: bool
) -> None:
    changes = changes_after((1, True))
    told = change(NS_PER_MS + 1)
    for stamp in range(2, 2 + later):
        changes.reading(reading(stamp * NS_PER_MS), certain=True)
    assert changes.take([told], spread=True) == ([told] if proved else [])
