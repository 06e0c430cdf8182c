"""The missed-tick policy."""

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.timebase import Duration, Instant
from hil.ticker import next_tick

PERIOD = Duration(1000)


def test_a_punctual_cycle_is_followed_by_the_next_tick() -> None:
    assert next_tick(Instant(5000), PERIOD, Instant(5600)) == (6000, 0)


def test_a_cycle_late_by_less_than_a_period_is_not_skipped() -> None:
    assert next_tick(Instant(5000), PERIOD, Instant(6999)) == (6000, 0)


def test_a_tick_that_is_over_is_skipped_and_counted() -> None:
    assert next_tick(Instant(5000), PERIOD, Instant(7000)) == (7000, 1)
    assert next_tick(Instant(5000), PERIOD, Instant(9500)) == (9000, 3)


@settings(derandomize=True, deadline=None)
@given(due=st.integers(0, 10**9), late=st.integers(0, 10**7), period=st.integers(1, 10**6))
def test_the_grid_is_kept_and_the_next_tick_is_not_over(due: int, late: int, period: int) -> None:
    now = Instant(due + late)
    due_at, missed = next_tick(Instant(due), Duration(period), now)
    assert (due_at - due) % period == 0
    assert due_at == due + (1 + missed) * period
    assert now < due_at + period
    assert missed == 0 or due_at <= now
