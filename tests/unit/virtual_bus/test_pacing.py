"""The paced timeline, on a clock that is itself simulated."""

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.timeline import PacedTimeline, SimulatedClock, Timeline


def paced() -> tuple[PacedTimeline, SimulatedClock]:
    clock = SimulatedClock(Timeline())
    clock.sleep_until(Instant(1_000_000))
    return PacedTimeline(clock), clock


def test_events_wait_for_the_clock_and_keep_their_instants() -> None:
    timeline, clock = paced()
    seen: list[tuple[int, int]] = []
    for due in (300, 100, 200):
        timeline.call_at(Instant(due), lambda now: seen.append((now, clock.now())))
    timeline.run_until(Instant(250))
    assert seen == [(100, 1_000_100), (200, 1_000_200)]
    assert (timeline.now, clock.now()) == (250, 1_000_250)
    assert timeline.step()
    assert seen[-1] == (300, 1_000_300)


def test_an_empty_wait_takes_its_time() -> None:
    timeline, clock = paced()
    assert not timeline.run_until_filled(Instant(500), [])
    assert (timeline.now, clock.now()) == (500, 1_000_500)


def test_a_wait_ends_with_the_event_that_fills_the_inbox() -> None:
    timeline, clock = paced()
    inbox: list[int] = []
    timeline.call_at(Instant(40), inbox.append)
    timeline.call_at(Instant(90), inbox.append)
    assert timeline.run_until_filled(Instant(500), inbox)
    assert inbox == [40]
    assert clock.now() == 1_000_040


def test_a_short_lag_is_made_good() -> None:
    timeline, clock = paced()
    clock.sleep_until(Instant(2_000_000))
    timeline.run_until(Instant(100))
    assert (timeline.now, clock.now()) == (100, 2_000_000)
    timeline.run_until(Instant(1_500_000))
    assert clock.now() == 2_500_000


def test_a_long_lag_is_not_followed_by_a_run_at_full_speed() -> None:
    timeline, clock = paced()
    clock.sleep_until(Instant(3_001_000_000))
    timeline.run_until(Instant(100))
    assert clock.now() == 3_001_000_000
    timeline.run_until(Instant(1_000_100))
    assert clock.now() == 3_002_000_000
