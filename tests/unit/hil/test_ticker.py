"""The missed-tick policy."""

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.timebase import Duration, Instant
from hil.ticker import next_due

PERIOD = Duration(1000)


def test_a_punctual_or_early_host_serves_the_tick() -> None:
    assert next_due(Instant(5000), PERIOD, Instant(5000)) == (5000, 0)
    assert next_due(Instant(5000), PERIOD, Instant(4000)) == (5000, 0)


def test_up_to_half_a_period_late_the_tick_is_served_at_once() -> None:
    assert next_due(Instant(5000), PERIOD, Instant(5500)) == (5000, 0)


def test_later_it_is_missed_and_the_next_one_is_waited_for() -> None:
    assert next_due(Instant(5000), PERIOD, Instant(5501)) == (6000, 1)
    assert next_due(Instant(5000), PERIOD, Instant(6500)) == (6000, 1)
    assert next_due(Instant(5000), PERIOD, Instant(9501)) == (10000, 5)


@settings(derandomize=True, deadline=None)
@given(due=st.integers(0, 10**9), late=st.integers(-(10**6), 10**7), period=st.integers(2, 10**6))
def test_syncs_of_served_ticks_are_half_a_period_apart(due: int, late: int, period: int) -> None:
    now = Instant(due + late)
    at, missed = next_due(Instant(due), Duration(period), now)
    assert at == due + missed * period
    assert now <= at + period // 2
    assert missed == 0 or now > at - period + period // 2, "no tick is skipped that could be served"
