"""Readings of a drive whose process stood still: late on the SYNC behind their own, or two of one instant."""

import pytest

from servobench.drivers.timebase import Instant
from servobench.hil.loop.samples import Dropout, DropoutCause, Sample
from tests.unit.hil.loop_fakes import PERIOD
from tests.unit.hil.test_clock_steps import DOUBTFUL, Stepping
from tests.unit.hil.test_stamp_attribution import DELAY

LATE = 300_000
"""More than any stamp was until it is seen once."""
AGAIN = 120_000
USUAL = 12
"""Cycles after which a question is answered."""


class Standing(Stepping):
    """As its base, with SYNCs that stay without a reading of their own."""

    def cycles(self, count: int = USUAL) -> None:
        """As usual."""
        for _ in range(count):
            self.cycle(self.log.marks[-1].number + 1)

    def late(self, late: int, unanswered: int = 1) -> int:
        """The drive acts on one of the next SYNCs so ``late``, and on those before not at all; number of the
        first."""
        first = self.log.marks[-1].number + 1
        for number in range(first, first + unanswered):
            self.sync(number)
        self.cycle(first + unanswered, late, DELAY + late)
        return first

    def lost(self, number: int) -> bool:
        """Whether the row of a SYNC without a reading is certain in the end."""
        row = Dropout(number, Instant(number * PERIOD), DropoutCause.LOST, True)
        return self.stamped.question.applied(row, None).certain

    def certain(self, number: int) -> bool:
        """The same of one that has a reading."""
        sample = next(sample for sample in self.samples if sample.sequence == number)
        row = self.stamped.question.applied(sample, sample.reading.received_at)
        assert isinstance(row, Sample)
        return row.certain


def stood(unanswered: int = 1) -> tuple[Standing, int]:
    """A drive that was late once, and for a while not; and the SYNC before that one."""
    rig = Standing()
    rig.cycles(40)
    number = rig.late(LATE, unanswered)
    rig.cycles()
    assert not rig.stamped.question.open
    assert rig.stamped.health.steps == 0
    return rig, number


def test_a_first_late_reading_may_be_of_the_sync_before_that_has_none() -> None:
    rig, number = stood()
    assert not rig.lost(number)
    assert not rig.certain(number + 1)


def test_so_may_every_later_one() -> None:
    rig, _ = stood()
    number = rig.late(AGAIN)
    assert rig.samples[-1].sampled_at_error_ns == DOUBTFUL
    assert not rig.lost(number)
    assert not rig.certain(number + 1)
    rig.cycles()
    assert rig.samples[-1].certain


def test_one_whose_sync_before_has_its_reading_is_certain() -> None:
    rig, _ = stood()
    number = rig.late(AGAIN, unanswered=0)
    assert rig.certain(number)


def test_one_that_is_not_late_tells_that_those_before_were_lost() -> None:
    rig, _ = stood()
    number = rig.late(0, unanswered=2)
    assert rig.lost(number)
    assert rig.lost(number + 1)
    assert rig.certain(number + 2)


def test_all_before_that_have_no_reading_are_in_doubt() -> None:
    rig, number = stood(unanswered=3)
    assert [rig.lost(each) for each in range(number - 1, number + 3)] == [True, False, False, False]


def test_lateness_that_is_not_rare_is_jitter() -> None:
    """So a loss beside it is one, but for the latest."""
    rig, _ = stood()
    for late in range(0, 8 * AGAIN, AGAIN // 4):
        rig.late(late % (2 * AGAIN), unanswered=0)
    number = rig.late(AGAIN)
    assert rig.lost(number)
    assert rig.certain(number + 1)


@pytest.mark.parametrize("late", [0, AGAIN])
@pytest.mark.parametrize("unanswered", [0, 1])
def test_a_copy_may_be_of_the_sync_before_sampled_at_the_same_instant(unanswered: int, late: int) -> None:
    """Of a drive that has a queue; a SYNC before that has its reading leaves the one that came twice."""
    rig, _ = stood()
    number = rig.late(late, unanswered)
    assert rig.place(number + unanswered, late, DELAY + late + 200_000) is None
    assert rig.stamped.health.duplicates == 1
    assert rig.certain(number + unanswered) is (unanswered == 0)
    assert rig.lost(number) is (unanswered == 0)


def test_one_that_came_later_than_a_queue_takes_is_a_copy() -> None:
    rig, _ = stood()
    number = rig.late(0)
    assert rig.place(number + 1, 0, DELAY + 2 * PERIOD) is None
    assert rig.certain(number + 1)
    assert rig.lost(number)


@pytest.mark.parametrize("unanswered", [0, 1])
def test_two_stamps_of_one_sync_may_be_of_the_one_before(unanswered: int) -> None:
    rig = Standing()
    rig.cycles(40)
    number = rig.late(0, unanswered)
    rig.place(number + unanswered, 2_000, DELAY + 200_000)
    rig.cycles()
    assert not rig.certain(number + unanswered)
    assert rig.lost(number) is (unanswered == 0)


@pytest.mark.parametrize(("every", "told"), [(1, True), (3, False)])
def test_a_drive_that_answers_each_sync_twice_is_named_once(every: int, told: bool) -> None:
    rig = Standing()
    rig.cycles(40)
    for cycle in range(200):
        number = rig.log.marks[-1].number + 1
        rig.sync(number)
        rig.place(number, 0, DELAY)
        if cycle % every == 0:
            rig.place(number, 20_000, DELAY + 200_000)
    assert sum("answers each SYNC twice" in text for text in rig.told) == told
