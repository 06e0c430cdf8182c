"""Readings while it is open whether the drive's clock was set, one by one until the question is answered."""

import pytest

from servobench.hil.loop.clock_question import AGREEING
from servobench.hil.loop.drive_stamps import MATCH_NS
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.stamp_attribution import REVOKED
from servobench.hil.loop.syncs import REMEMBERED
from tests.unit.hil.loop_fakes import PERIOD, TRANSIT
from tests.unit.hil.test_stamp_attribution import DELAY, FIRST, OFFSET, Rig

STEPS = [200_000, -200_000, 3 * PERIOD, 37_000]
DOUBTFUL = REMEMBERED * PERIOD


class Stepping(Rig):
    """As its base, one cycle after the other."""

    def __init__(self) -> None:
        super().__init__()
        self.samples: list[Sample] = []

    def cycle(self, number: int, step: int = 0, delay: int = DELAY) -> Sample:
        """A SYNC and its reading, by a clock that was set by ``step``."""
        self.sync(number)
        sample = self.place(number, step, delay)
        assert sample is not None
        self.samples.append(sample)
        return sample

    def amended(self) -> list[tuple[int, bool, int]]:
        """What the rows say in the end."""
        rows = [self.stamped.question.applied(sample, sample.reading.received_at) for sample in self.samples]
        return [
            (row.sequence, row.certain, row.sampled_at_error_ns) for row in rows if isinstance(row, Sample)
        ]

    def state(self) -> tuple[bool, int | None, bool]:
        question = self.stamped.question
        return question.open, question.since, question.cleared


@pytest.mark.parametrize("step", STEPS)
def test_eight_readings_show_by_how_much_a_clock_was_set(step: int) -> None:
    rig = Stepping()
    for number in range(FIRST, FIRST + AGREEING - 1):
        sample = rig.cycle(number, step)
        assert (sample.sequence, sample.sampled_at) == (number, number * PERIOD), "the likeliest"
        assert (sample.certain, sample.sampled_at_error_ns) == (False, DOUBTFUL)
        assert (rig.state(), rig.told) == ((True, None, False), [])
    rig.cycle(FIRST + AGREEING - 1, step)
    assert rig.told == [f"its clock was set by {step // 1000:+d} us, which {AGREEING} readings have shown"]
    assert (rig.state(), rig.stamped.health.steps) == ((False, None, True), 1)
    error = 2 * rig.match_ns
    assert rig.amended() == [(number, True, error) for number in range(FIRST, FIRST + AGREEING)]
    following = rig.cycle(FIRST + AGREEING, step)
    assert (following.certain, following.sampled_at) == (True, (FIRST + AGREEING) * PERIOD)
    assert rig.stamped.health.two_stamps == 0


def test_a_clock_that_is_set_back_by_a_period_leaves_its_readings_in_doubt() -> None:
    """Each lies on the SYNC before its own, which looks free; that it was not shows when eight agree."""
    rig = Stepping()
    guesses = [rig.cycle(number, 2_000 - PERIOD).sequence for number in range(FIRST, FIRST + AGREEING)]
    assert guesses == [FIRST, *range(FIRST, FIRST + AGREEING - 1)]
    assert rig.told == [f"its clock was set by -998 us, which {AGREEING} readings have shown"]
    assert rig.state() == (False, None, False)
    assert {(certain, error) for _, certain, error in rig.amended()} == {(False, DOUBTFUL)}
    following = rig.cycle(FIRST + AGREEING, 2_000 - PERIOD)
    assert (following.certain, following.sequence) == (True, FIRST + AGREEING)


def test_a_clock_that_is_set_twice_has_two_questions() -> None:
    rig = Stepping()
    for number in range(FIRST, FIRST + AGREEING):
        rig.cycle(number, 200_000)
    rig.stamped.question.cleared = False
    for number in range(FIRST + AGREEING, FIRST + 2 * AGREEING):
        rig.cycle(number, 120_000)
    assert rig.told == [
        f"its clock was set by {text} us, which {AGREEING} readings have shown" for text in ("+200", "-80")
    ]
    assert all(certain for _, certain, _ in rig.amended())


def test_a_reading_that_comes_twice_while_it_is_open_is_one() -> None:
    rig = Stepping()
    rig.cycle(FIRST, 200_000)
    assert rig.place(FIRST, 200_000) is None
    assert rig.stamped.health.duplicates == 1
    for number in range(FIRST + 1, FIRST + AGREEING - 1):
        rig.cycle(number, 200_000)
    assert rig.told == [], "it is not counted among those that agree"


def test_one_reading_that_was_held_up_is_cleared_by_the_next() -> None:
    rig = Stepping()
    rig.cycle(FIRST, delay=DELAY + PERIOD * 6 // 10)
    assert rig.state() == (True, None, False)
    error = 2 * (rig.match_ns)
    rig.cycle(FIRST + 1)
    assert rig.state() == (False, None, True)
    assert rig.amended() == [(FIRST, True, error), (FIRST + 1, True, error)]
    assert rig.stamped.place(rig.reading(FIRST, 0, 9 * PERIOD)) is None, "its SYNC has its reading now"
    assert rig.stamped.health.duplicates == 1


def test_a_stamp_off_all_syncs_stays_uncertain_though_the_clock_is_as_it_was() -> None:
    rig = Stepping()
    rig.cycle(FIRST, 100_000)
    following = rig.cycle(FIRST + 1)
    assert rig.state() == (False, None, False), "one reading is left in doubt"
    assert following.certain
    assert rig.amended()[0] == (FIRST, False, DOUBTFUL)


def test_two_readings_that_were_guessed_to_be_one_sync_s_stay_uncertain() -> None:
    rig = Stepping()
    rig.cycle(FIRST, delay=DELAY + PERIOD * 6 // 10)
    again = rig.place(FIRST, 100_000)
    assert again is not None
    assert (again.sequence, again.certain) == (FIRST, False)
    rig.cycle(FIRST + 1)
    assert rig.state() == (False, None, False)
    assert rig.amended()[0] == (FIRST, False, DOUBTFUL)


def test_a_network_that_became_slower_is_no_clock_that_was_set() -> None:
    """By 0.6 periods, from one reading to the next and for ever."""
    rig = Stepping()
    slower = DELAY + PERIOD * 6 // 10
    for number in range(FIRST, FIRST + AGREEING):
        assert not rig.cycle(number, delay=slower).certain or number == FIRST + AGREEING - 1
    assert (rig.told, rig.stamped.health.steps) == ([], 0)
    assert rig.state() == (False, None, True)
    assert all(certain for _, certain, _ in rig.amended())
    assert rig.cycle(FIRST + AGREEING, delay=slower).certain
    assert (rig.told, rig.state()) == ([], (False, None, True))


def test_without_a_free_sync_a_reading_answers_none() -> None:
    rig = Rig()
    assert rig.place(FIRST - 1, 100_000, DELAY + 1) is None, "the last SYNC has its reading"
    assert (rig.stamped.health.unmatched, rig.stamped.health.placed) == (1, 0)
    assert rig.stamped.question.open


@pytest.mark.parametrize(("sooner", "answered"), [(0, True), (1, False)])
def test_a_stamp_from_after_its_frame_s_start_is_no_matter_of_the_network(
    sooner: int, answered: bool
) -> None:
    """No network brings a reading before it was taken: the next usual reading does not answer that."""
    rig = Stepping()
    rig.sync(FIRST)
    at = rig.stamped.clock.place(FIRST * PERIOD + 100_000 + OFFSET)
    delay = at - FIRST * PERIOD + TRANSIT - MATCH_NS - sooner
    assert rig.place(FIRST, 100_000, delay) is not None
    rig.cycle(FIRST + 1)
    assert rig.state() == (not answered, None, False)


# ---- SYNCs that came late to the drive, by a period ------------------------------------------------------


def two_on_one_sync(rig: Stepping, number: int) -> None:
    """A drive that stood still answers SYNC ``number``, and in the same instant the one after it."""
    rig.sync(number)
    rig.sync(number + 1)
    for late, delay in ((2_000, DELAY), (0, DELAY + 300)):
        sample = rig.place(number + 1, late, delay)
        assert sample is not None
        rig.samples.append(sample)


def test_of_two_stamps_for_one_sync_its_row_is_uncertain_and_the_run_no_worse() -> None:
    rig = Stepping()
    two_on_one_sync(rig, FIRST)
    rig.cycle(FIRST + 2)
    assert rig.state() == (False, None, False)
    rows = rig.amended()
    assert rows[:2] == [(FIRST + 1, False, DOUBTFUL), (FIRST, False, DOUBTFUL)]
    assert rows[2][:2] == (FIRST + 2, True)
    assert rig.stamped.health.two_stamps == 0


def test_two_stamps_for_a_sync_whose_row_is_recorded_are_an_alarm() -> None:
    rig = Stepping()
    rig.sync(FIRST)
    rig.cycle(FIRST + 1, 2_000)
    assert rig.amended()[0][1]
    assert rig.place(FIRST + 1) is not None
    rig.cycle(FIRST + 2)
    assert rig.stamped.health.two_stamps == 1


def test_two_stamps_for_one_sync_stay_in_doubt_where_delays_spread() -> None:
    rig = spread()
    two_on_one_sync(rig, FIRST + 5)
    rig.cycle(FIRST + 7)
    assert rig.stamped.health.two_stamps == 0
    assert [certain for _, certain, _ in rig.amended()] == [True] * 5 + [False] * 2 + [True]


@pytest.mark.parametrize("spreads", [False, True])
def test_a_second_stamp_behind_a_step_leaves_the_first_where_it_was(spreads: bool) -> None:
    """The first reading behind it lies on the SYNC before its own, which stays in doubt if delays spread."""
    rig = spread() if spreads else Stepping()
    first = FIRST + len(rig.samples)
    for number in range(first, first + 1 + REVOKED + AGREEING):
        rig.cycle(number, 2_000 - PERIOD if number > first else 0)
    assert rig.stamped.health.steps == 1
    row = next(row for row in rig.amended() if row[0] == first)
    assert row[1] is not spreads


# ---- delays that spread over more than half a period ------------------------------------------------------


def spread() -> Stepping:
    """Delays from 0.25 to 0.85 periods, after five cycles."""
    rig = Stepping()
    for number in range(FIRST, FIRST + 5):
        rig.cycle(number, delay=DELAY + (number % 2) * PERIOD * 3 // 10)
    rig.stamped._case.delays.add(DELAY + PERIOD * 6 // 10)
    assert rig.stamped.spread
    return rig


def test_where_delays_spread_the_last_placements_are_in_doubt_as_well() -> None:
    rig = spread()
    rig.cycle(FIRST + 5, 100_000)
    assert rig.state() == (True, FIRST, False)
    assert rig.amended() == [(number, False, DOUBTFUL) for number in range(FIRST, FIRST + 6)]


def test_they_are_as_they_were_when_the_clock_is() -> None:
    rig = spread()
    before = [(sample.sequence, True, sample.sampled_at_error_ns) for sample in rig.samples]
    rig.cycle(FIRST + 5, 100_000)
    rig.cycle(FIRST + 6)
    assert rig.state() == (False, None, False)
    assert rig.amended()[:5] == before
    for number in range(FIRST, FIRST + 5):
        assert rig.place(number) is None
    assert rig.stamped.health.duplicates == 5, "each has its SYNC again"
