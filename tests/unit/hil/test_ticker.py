"""The missed-tick policy."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.pace import ticks_missed, ticks_passed
from tests.draws import examples_of

PERIOD = Duration(1000)


def test_a_punctual_or_early_host_misses_nothing() -> None:
    assert ticks_missed(Instant(5000), PERIOD, Instant(5000)) == 0
    assert ticks_missed(Instant(5000), PERIOD, Instant(4000)) == 0


def test_up_to_half_a_period_late_the_tick_is_served_at_once() -> None:
    assert ticks_missed(Instant(5000), PERIOD, Instant(5500)) == 0


def test_later_it_is_missed_and_the_next_one_is_waited_for() -> None:
    assert ticks_missed(Instant(5000), PERIOD, Instant(5501)) == 1
    assert ticks_missed(Instant(5000), PERIOD, Instant(6500)) == 1
    assert ticks_missed(Instant(5000), PERIOD, Instant(9501)) == 5


@examples_of(100)
@given(due=st.integers(0, 10**9), late=st.integers(-(10**6), 10**7), period=st.integers(2, 10**6))
def test_no_tick_is_missed_that_could_be_served(due: int, late: int, period: int) -> None:
    now = Instant(due + late)
    missed = ticks_missed(Instant(due), Duration(period), now)
    at = due + missed * period
    assert now <= at + period // 2
    assert missed == 0 or now > at - period + period // 2


@pytest.mark.parametrize(
    ("handed_at", "passed"), [(4000, 0), (5000, 0), (5999, 0), (6000, 1), (6999, 1), (7000, 2), (9500, 4)]
)
def test_whole_periods_behind_a_tick_are_passed(handed_at: int, passed: int) -> None:
    assert ticks_passed(Instant(5000), PERIOD, Instant(handed_at)) == passed
