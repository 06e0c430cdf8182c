"""The event heap: order, cancelling, and time that never runs backwards."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.draws import examples_of

EXAMPLES = examples_of(100)


def test_events_run_in_order_of_time_then_of_entry() -> None:
    timeline = Timeline()
    seen: list[tuple[str, int]] = []
    for name, when in (("late", 30), ("first", 10), ("second", 10), ("third", 10)):
        timeline.call_at(Instant(when), lambda now, name=name: seen.append((name, now)))  # type: ignore[misc]
    timeline.run_until(Instant(100))
    assert seen == [("first", 10), ("second", 10), ("third", 10), ("late", 30)]
    assert timeline.now == 100


@EXAMPLES
@given(st.lists(st.integers(0, 50), max_size=40), st.integers(0, 60))
def test_run_until_is_a_stable_sort_up_to_its_instant(instants: list[int], limit: int) -> None:
    timeline = Timeline()
    seen: list[tuple[int, int]] = []
    for number, when in enumerate(instants):
        timeline.post(Instant(when), lambda now, number=number: seen.append((now, number)))  # type: ignore[misc]
    timeline.run_until(Instant(limit))
    assert seen == sorted((when, number) for number, when in enumerate(instants) if when <= limit)
    assert timeline.now == limit
    assert timeline.next_at() == min((when for when in instants if when > limit), default=None)


def test_event_entered_for_the_present_instant_runs_within_the_same_call() -> None:
    timeline = Timeline()
    seen: list[int] = []
    timeline.call_at(Instant(5), lambda now: timeline.call_at(now, seen.append))
    timeline.run_until(Instant(5))
    assert seen == [5]


def test_past_instant_means_now() -> None:
    timeline = Timeline()
    timeline.run_until(Instant(50))
    seen: list[int] = []
    timeline.call_at(Instant(10), seen.append)
    assert timeline.next_at() == 50
    assert timeline.step()
    assert seen == [50]


def test_cancelled_event_neither_runs_nor_counts() -> None:
    timeline = Timeline()
    seen: list[int] = []
    event = timeline.call_at(Instant(10), seen.append)
    timeline.call_at(Instant(20), seen.append)
    event.cancel()
    assert not event.pending
    assert timeline.next_at() == 20
    assert timeline.step()
    assert not timeline.step()
    assert seen == [20]


def test_event_runs_once_and_is_no_longer_pending() -> None:
    timeline = Timeline()
    seen: list[int] = []
    event = timeline.call_at(Instant(10), seen.append)
    assert event.pending
    timeline.run_until(Instant(10))
    assert not event.pending
    event.cancel()
    assert seen == [10]


def test_run_until_an_earlier_instant_changes_nothing() -> None:
    timeline = Timeline()
    timeline.run_until(Instant(50))
    timeline.run_until(Instant(20))
    assert timeline.now == 50


def test_run_until_filled_stops_at_the_event_that_fills() -> None:
    timeline = Timeline()
    inbox: list[int] = []
    other: list[int] = []
    timeline.call_at(Instant(10), other.append)
    timeline.call_at(Instant(20), inbox.append)
    timeline.call_at(Instant(20), other.append)
    assert timeline.run_until_filled(Instant(100), inbox)
    assert (timeline.now, inbox, other) == (20, [20], [10])
    assert timeline.run_until_filled(Instant(100), inbox)
    assert timeline.now == 20  # what is there already costs no time
    inbox.clear()
    assert not timeline.run_until_filled(Instant(100), inbox)
    assert (timeline.now, other) == (100, [10, 20])


def test_run_until_filled_includes_its_last_instant() -> None:
    timeline = Timeline()
    inbox: list[int] = []
    timeline.call_at(Instant(20), inbox.append)
    assert not timeline.run_until_filled(Instant(19), inbox)
    assert timeline.run_until_filled(Instant(20), inbox)


def test_failing_event_leaves_the_timeline_usable() -> None:
    timeline = Timeline()
    seen: list[int] = []

    def fail(_now: Instant) -> None:
        raise ZeroDivisionError

    timeline.call_at(Instant(10), fail)
    timeline.call_at(Instant(20), seen.append)
    with pytest.raises(ZeroDivisionError):
        timeline.run_until(Instant(30))
    assert timeline.now == 10
    timeline.run_until(Instant(30))
    assert seen == [20]


def test_clock_sleeps_by_running_the_events() -> None:
    timeline = Timeline()
    clock = SimulatedClock(timeline)
    seen: list[int] = []
    timeline.call_at(Instant(7), seen.append)
    clock.sleep_until(Instant(9))
    assert (clock.now(), seen) == (9, [7])
    clock.sleep_until(Instant(3))
    assert clock.now() == 9
