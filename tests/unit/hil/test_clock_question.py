"""The ways to place readings while it is open whether a drive's clock was set, each with its cost."""

from random import Random

import pytest

from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.clock_map import STAMP_RESOLUTION
from servobench.hil.loop.clock_question import DRIFT_WITHIN, ClockQuestion
from servobench.hil.loop.drive_stamps import MATCH_NS as MATCH
from servobench.hil.loop.drive_stamps import DriveStamps
from servobench.hil.loop.suspects import Line, Suspect
from servobench.hil.loop.syncs import SURPLUS, SyncLog

PERIOD = Duration(NS_PER_MS)
TRANSIT = Duration(76_000)
DELAY = 250_000


# ---- the ways out ----------------------------------------------------------------------------------------


class Case:
    """SYNCs 1, 2, ... a period apart, of which the first has answered; a clock that runs like the host's."""

    def __init__(self, syncs: int = 12, lost_syncs: tuple[int, ...] = ()) -> None:
        self.log = SyncLog(Duration(0), PERIOD, EchoBasis.BUS)
        for number in range(1, syncs + 1):
            if number in lost_syncs:
                self.log.handed(number, self.at(number))
            else:
                self.log.heard(number, self.at(number))
        stamps = DriveStamps(PERIOD, 0, STAMP_RESOLUTION)
        self.clock = stamps.clock
        self.clock.observe(0, Instant(0), 0.0)
        self.case = ClockQuestion(self.log, stamps, PERIOD, TRANSIT, False)
        self.case.delays.add(DELAY)

    @staticmethod
    def at(number: int) -> Instant:
        return Instant(number * PERIOD)

    def suspects(self, *numbers: int, step: int = 0, delay: int = DELAY, off: int = 0) -> list[Suspect]:
        """Readings of these SYNCs by a clock that was set by ``step``."""
        return [Suspect(self.at(number) + step + off, Instant(self.at(number) + delay)) for number in numbers]

    def lines(self, suspects: list[Suspect]) -> dict[tuple[int, ...], tuple[int, int, bool]]:
        """By the SYNCs: cost, change of the smallest delay, and whether the clock was set."""
        return {
            tuple(mark.number for mark in line.marks if mark): (line.cost, line.delay_change, line.steps)
            for line in self.case.lines(suspects)
        }


def test_as_the_clock_runs_nothing_has_happened() -> None:
    """Each earlier line needs a step, and delays longer by a period."""
    case = Case(4)
    case.case.since = 1
    assert case.lines(case.suspects(2, 3, 4)) == {
        (1, 2, 3): (3 + 3, PERIOD, True),
        (2, 3, 4): (0, 0, False),
    }


def test_a_line_is_of_marks_and_whether_it_steps() -> None:
    case = Case(3)
    case.case.since = 2
    (line,) = [each for each in case.case.lines(case.suspects(3)) if each.marks == (case.log.marks[2],)]
    assert line == Line(0, 0, (case.log.marks[2],), False, 0.0, 0, False)


@pytest.mark.parametrize(("step", "steps"), [(4_000, False), (10_000, True), (-10_000, True)])
def test_a_clock_that_was_set_costs_a_step(step: int, steps: bool) -> None:
    """Beyond what stamp and map may be off: 3 us, and 1 us and more of the clock's."""
    case = Case(4)
    case.case.since = 1
    suspects = case.suspects(2, 3, 4, step=step)
    assert case.clock.error_ns in range(2_000, 3_000)
    assert case.lines(suspects)[2, 3, 4] == ((3, 0, True) if steps else (0, 0, False))


@pytest.mark.parametrize(
    ("since", "twice", "plain", "stepped"),
    [
        (4, 0, 0, 3),
        (3, 0, 1, 4),
        (2, 0, 2, 5),
        (1, 0, 2, 5),
        (3, 1, 2, 3),
        (2, 1, 2, 4),
        (4, 1, 1, 3),
        (4, 3, 2, 3),
    ],
)
def test_losses_cost_up_to_two_and_readings_that_came_twice_excuse_a_step(
    since: int, twice: int, plain: int, stepped: int
) -> None:
    for step, cost in ((0, plain), (200_000, stepped)):
        case = Case(7)
        case.case.since, case.case.twice = since, twice
        assert case.lines(case.suspects(5, 6, 7, step=step))[5, 6, 7] == (cost, 0, step != 0)


def test_a_sync_that_never_came_to_the_bus_is_no_loss() -> None:
    case = Case(6, lost_syncs=(4,))
    case.case.since = 2
    assert case.lines(case.suspects(5, 6))[5, 6] == (1, 0, False), "3 alone"


@pytest.mark.parametrize(("change", "cost"), [(500_000, 0), (500_001, 3)])
def test_a_smallest_delay_that_changes_by_more_than_half_a_period_costs(change: int, cost: int) -> None:
    case = Case(3)
    case.case.since = 1
    assert case.lines(case.suspects(2, 3, delay=DELAY + change))[2, 3] == (cost, change, False)


def test_where_delays_spread_what_four_mean_gaps_explain_is_no_change() -> None:
    case = Case(4)
    case.case.since = 1
    for number in range(99):
        case.case.delays.add(DELAY + (500_000 if number % 2 else 0))
    slack = 4 * 500_000 // 100
    assert case.lines(case.suspects(2, 3, 4, delay=DELAY + 500_000 + slack))[2, 3, 4][0] == 0
    assert case.lines(case.suspects(2, 3, 4, delay=DELAY + 500_001 + slack))[2, 3, 4][0] == 3


@pytest.mark.parametrize(
    ("watermark_us", "lines"),
    [(0, {(1, 2, 3, 4, 5, 6, 7, 8), (2, 3, 4, 5, 6, 7, 8, 9)}), (5, {(2, 3, 4, 5, 6, 7, 8, 9)})],
)
def test_syncs_that_are_not_at_equal_distances_tell_which_ones_they_are(
    watermark_us: int, lines: set[tuple[int, ...]]
) -> None:
    case, draw = Case(0), Random(1)
    case.case.since = 1
    ends = [case.at(number) + round(watermark_us * 1_000 * draw.random()) for number in range(10)]
    for number in range(1, 10):
        case.log.heard(number, Instant(ends[number]))
    suspects = [Suspect(at // 1_000 * 1_000, Instant(at + DELAY)) for at in ends[2:]]
    assert set(case.lines(suspects)) == lines


def test_no_reading_comes_sooner_than_a_frame() -> None:
    case = Case(3)
    case.case.since = 1
    assert (2, 3) in case.lines(case.suspects(2, 3, delay=TRANSIT - MATCH))
    assert (2, 3) not in case.lines(case.suspects(2, 3, delay=TRANSIT - MATCH - 1))
    early = [*case.suspects(2), *case.suspects(3, delay=TRANSIT - MATCH - 1)]
    assert (2, 3) not in case.lines(early), "nor the second"


def test_a_stamp_is_near_its_sync() -> None:
    """As far as it may be off, and a drift of 2000 ppm over half a period."""
    most = MATCH + round(DRIFT_WITHIN * PERIOD / 2)
    for off, fits in ((most, True), (most + 1, False), (-most, True), (-most - 1, False)):
        case = Case(3)
        case.case.since = 1
        suspects = [*case.suspects(2), *case.suspects(3, off=off)]
        assert ((2, 3) in case.lines(suspects)) is fits, off


def test_a_drift_is_followed_from_suspect_to_suspect() -> None:
    case = Case(8)
    case.case.since = 1
    suspects = [each for number in range(2, 9) for each in case.suspects(number, off=3_500 * (number - 2))]
    assert (2, 3, 4, 5, 6, 7, 8) in case.lines(suspects)


def test_two_readings_lie_on_two_syncs_and_none_on_a_surplus_one() -> None:
    case = Case(3)
    case.case.since = 1
    twice = [*case.suspects(2), Suspect(case.at(2) + 500, Instant(case.at(2) + DELAY + 9))]
    assert case.lines(twice) == {}
    case.log.heard(SURPLUS, case.at(4))
    assert (3, 4) not in case.lines(case.suspects(3, 4))


def test_a_sync_that_has_another_stamp_is_taken() -> None:
    case = Case(4)
    case.case.since = 1
    case.case.stamps[3] = case.at(3) + 700
    assert (2, 3, 4) not in case.lines(case.suspects(2, 3, 4))
    case.case.stamps[3] = case.at(3)
    assert (2, 3, 4) in case.lines(case.suspects(2, 3, 4))


def test_readings_before_a_step_must_have_had_a_place_as_well() -> None:
    """Two, placed on 4 and 5; the suspects lie on 6 and 7 by a clock that was set back by ``back`` SYNCs."""

    def possible(back: int, *taken: int) -> bool:
        case = Case(9)
        case.case.since = 3
        case.case.revoked = [(case.log.marks[3], case.at(4)), (case.log.marks[4], case.at(5))]
        for number in taken:
            case.case.stamps[number] = case.at(number) - 1
        return (6, 7) in case.lines(case.suspects(6, 7, step=-back * PERIOD))

    assert possible(1), "the step came behind both"
    assert not possible(1, 5), "5 is taken, and behind the step it would lie on 6"
    assert not possible(1, 4), "as 5 does where 4 moves to it"
    assert possible(0, 4, 5), "without a step nothing is asked"
    assert possible(4, 4, 5), "behind the step they lie on 8 and 9"
    assert possible(4, 5, 8), "the first before it, on 4, the second on 9"
    assert not possible(4, 4, 8)
    assert not possible(4, 5, 9)


@pytest.mark.parametrize(("late", "holds"), [(1, True), (2, False)])
def test_one_sync_in_eight_may_be_later_than_any_was_and_the_clock_as_it_was(late: int, holds: bool) -> None:
    """Though it is the first, from which the lines of a clock that was set are drawn."""
    case = Case(9)
    case.case.since = 1
    suspects = [*case.suspects(*range(2, 2 + late), off=300_000), *case.suspects(*range(2 + late, 10))]
    answers = case.case.answers(suspects, unlikely=False)
    assert (
        (2, 3, 4, 5, 6, 7, 8, 9) in [tuple(mark.number for mark in line.marks if mark) for line in answers]
    ) is holds
    assert not any(line.steps for line in answers)


@pytest.mark.parametrize(("change", "taken"), [(990_000, True), (1_000_000, False)])
def test_a_step_and_another_delay_are_an_answer_only_where_there_is_none_else(
    change: int, taken: bool
) -> None:
    case = Case(9)
    case.case.since = 1
    suspects = case.suspects(*range(2, 10), step=300_000, delay=DELAY + change)
    assert case.case.answers(suspects, unlikely=False) == []
    assert bool(case.case.answers(suspects, unlikely=True)) is taken


def test_a_reading_before_its_sync_shows_that_the_clock_was_set() -> None:
    case = Case(12)
    assert not case.case.was_set(case.suspects(*range(2, 10)))
    assert case.case.was_set(case.suspects(*range(2, 10), step=PERIOD))


def test_a_delay_longer_than_delays_spread_is_not_proved_behind_a_step() -> None:
    """It may be that of a reading from before another step."""
    case = Case(12)
    suspects = [*case.suspects(2, delay=DELAY + PERIOD), *case.suspects(*range(3, 10))]
    placed = [(suspect, case.log.marks[place]) for place, suspect in enumerate(suspects, 1)]
    assert case.case.alike(placed) == placed[1:]
