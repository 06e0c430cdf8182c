"""By how many periods what a drive sends by a timer comes later than it did."""

import pytest

from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.loop.beats import KNOWN_MIN, Beats

PERIOD = Duration(NS_PER_MS)
TIMER = 25 * PERIOD
BEFORE, AFTER = Instant(11 * TIMER + 3 * PERIOD), Instant(11 * TIMER + 5 * PERIOD)
"""Readings are missing between."""
SPREAD = 100_000
KNOWN = [place * TIMER for place in range(1, 12)]


def late(came: list[int], timer: int = TIMER) -> int | None:
    beats = Beats(PERIOD, Duration(timer))
    for at in came:
        beats.take(Instant(at))
    return beats.periods_late(BEFORE, AFTER, SPREAD)


@pytest.mark.parametrize(("off", "periods"), [(0, 0), (1_989_000, 2), (-1_100_000, -1), (1_500_000, None)])
def test_a_beat_that_is_late_by_whole_periods_tells_by_how_many(off: int, periods: int | None) -> None:
    assert late([*KNOWN, 12 * TIMER + off, 13 * TIMER + off]) == periods


def test_one_that_is_missing_or_came_twice_moves_no_other() -> None:
    copied = [*KNOWN[:5], KNOWN[4] + 1_800_000, *KNOWN[5:]]
    assert late([*copied, 12 * TIMER, 12 * TIMER + 1_800_000]) == 0
    assert late([*KNOWN, KNOWN[-1] + 1_800_000, 12 * TIMER]) == 0
    assert late([*KNOWN[:5], *KNOWN[6:], 13 * TIMER + PERIOD, 14 * TIMER + PERIOD]) == 1
    held = [*KNOWN[:5], KNOWN[5] + 1_400_000, *KNOWN[6:]]
    assert late([*held, 12 * TIMER + PERIOD, 13 * TIMER + PERIOD]) == 1
    assert late([*held, 12 * TIMER + PERIOD]) is None, "it may have been held up as well"


def test_a_change_that_is_told_at_once_begins_the_timer_anew() -> None:
    anew = [*KNOWN[:4], KNOWN[4] - 9 * PERIOD]
    while anew[-1] + TIMER < BEFORE:
        anew.append(anew[-1] + TIMER)
    assert late([*anew, *(anew[-1] + place * TIMER + PERIOD for place in (1, 2))]) == 1


@pytest.mark.parametrize(
    "came",
    [
        pytest.param(KNOWN, id="none came since"),
        pytest.param([12 * TIMER], id="none is known"),
        pytest.param(
            [*(at + at // TIMER % 3 * 400_000 for at in KNOWN), 12 * TIMER], id="they spread over a period"
        ),
    ],
)
def test_what_says_nothing(came: list[int]) -> None:
    assert late(came) is None


def test_a_statusword_that_comes_with_the_readings_says_nothing() -> None:
    assert late([*KNOWN, 12 * TIMER], timer=0) is None


def test_where_few_are_known_the_timer_says_when_the_next_is_due() -> None:
    slow = [at + at // TIMER * 30_000 for at in [*KNOWN, 12 * TIMER + PERIOD, 13 * TIMER + PERIOD]]
    assert [late(slow[-count:]) for count in (3, 4, KNOWN_MIN + 2)] == [1, 1, 1]
    fast = [at - at // TIMER * 300_000 for at in [*KNOWN, 12 * TIMER + PERIOD, 13 * TIMER + PERIOD]]
    assert late(fast) == 1, "the timer is not what it was set to"
    assert [late([KNOWN[-1] + held, 12 * TIMER]) for held in (400_000, 600_000)] == [0, None]


def test_a_step_begins_the_line_anew() -> None:
    beats = Beats(PERIOD, Duration(TIMER))
    for at in [*KNOWN, *(place * TIMER + 2 * PERIOD for place in range(12, 19))]:
        beats.take(Instant(at))
    behind = Instant(17 * TIMER + 3 * PERIOD)
    assert beats.periods_late(behind, behind, SPREAD) == 0
