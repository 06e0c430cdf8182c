"""Of which SYNC a torque demand is that came in a frame of its own, by its place among the readings."""

import pytest

from servobench.drivers.exchange import Readback
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.readback_tie import ReadbackTie
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.syncs import SyncLog
from tests.unit.hil.loop_fakes import reading_at

PERIOD = Duration(NS_PER_MS)
READING_AFTER, DEMAND_AFTER = 100_000, 200_000


def at(number: int) -> Instant:
    """The end of a SYNC, which had been handed over just then."""
    return Instant(number * PERIOD)


@pytest.mark.parametrize(("late", "hidden"), [(0, False), (NS_PER_MS, True)])
def test_a_demand_long_behind_its_reading_may_be_of_anothers_sync_that_was_not_heard(
    late: int, hidden: bool
) -> None:
    """Of SYNC 2, lost on the way to the host, the reading answers nothing that is known."""
    syncs = SyncLog(Duration(0), PERIOD, EchoBasis.BUS)
    tie = ReadbackTie(syncs, PERIOD, 20)
    syncs.heard(1, at(1))
    received_at = Instant(at(1) + READING_AFTER)
    tie.reading(Sample(1, reading_at(received_at), at(1), 0, True), received_at, False)
    tie.doubt()
    if hidden:
        tie.reading(None, Instant(at(2) + READING_AFTER), False)
    told_at = Instant(at(1) + DEMAND_AFTER + late)
    (telling,) = tie.take([Readback(7, told_at, 1 + hidden)], at_end=False)
    assert telling.sync is None
    assert telling.until == (told_at if hidden else at(1))


@pytest.mark.parametrize("unsent", [False, True])
def test_a_demand_behind_a_sync_that_was_not_heard_may_be_of_it(unsent: bool) -> None:
    """Of SYNC 2 echo and reading were dropped by the host, and of SYNC 1 the demand; or SYNC 2 was not sent,
    and the demand is SYNC 1's, late."""
    syncs = SyncLog(Duration(0), PERIOD, EchoBasis.BUS)
    tie = ReadbackTie(syncs, PERIOD, 20)
    for number in (1, 2, 3):
        syncs.handed(number, at(number))
        if number != 2:
            syncs.came(at(number), at(number))
            received_at = Instant(at(number) + READING_AFTER)
            tie.reading(Sample(number, reading_at(received_at), at(number), 0, True), received_at, False)
        elif unsent:
            syncs.never_sent(at(number))
        else:
            syncs.not_heard(Instant(at(number) + READING_AFTER))
    told_at = Instant(at(2) + DEMAND_AFTER)
    (telling,) = tie.take([Readback(7, told_at, 1)], at_end=False)
    if unsent:
        assert telling.sync is not None
        assert telling.sync.number == 1
    else:
        assert telling.sync is None
        assert telling.since <= at(1) < at(2) <= telling.until


@pytest.mark.parametrize("late_ns", [0, 400_000])
def test_a_sync_that_is_stamped_late_may_have_ended_as_much_earlier(late_ns: int) -> None:
    """Its own reading was lost, so that nothing else tells when the drive sampled."""
    syncs = SyncLog(Duration(0), PERIOD, EchoBasis.KERNEL)
    tie = ReadbackTie(syncs, PERIOD, 20)
    for number in range(1, 40):
        syncs.heard(number, Instant(at(number) + (late_ns if number % 2 else 0)))
    received_at = Instant(at(38) + READING_AFTER)
    tie.reading(Sample(38, reading_at(received_at), at(38), 0, True), received_at, False)
    for number, count in ((38, 1), (39, 1)):
        told_at = Instant(at(number) + late_ns + DEMAND_AFTER)
        tellings = tie.take([Readback(7, told_at, count)], at_end=number == 39)
    assert tellings[-1].since <= at(39)
    assert tellings[-1].since > at(38) or late_ns
