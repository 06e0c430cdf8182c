"""A host that stands still within a run is told of, and what ends the run then says what keeps it running."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, MonotonicClock, suspended
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.execution.conclusion import Standstill
from servobench.hil.execution.world import World, WorldPlan, open_world

PERIOD = Duration(NS_PER_MS)


@pytest.fixture(name="world")
def world_in_real_time() -> Iterator[World]:
    """A simulated one that says that its time passes by itself."""
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000), []) as world:
        yield replace(world, real_time=True)


def standstill(world: World, asleep_s: Iterator[float]) -> tuple[Standstill, list[tuple[str, str]]]:
    """Attended each 50 ms for a second, and what it tells."""
    told: list[tuple[str, str]] = []
    watch = Standstill(
        world,
        PERIOD,
        lambda text, level: told.append((text, level)),
        lambda: Duration(round(next(asleep_s) * NS_PER_S)),
    )
    for _ in range(20):
        watch.attend()
        passes(world, 50)
    watch.attend()
    assert told == []
    return watch, told


def passes(world: World, ms: int) -> None:
    world.clock.sleep_until(Instant(world.clock.now() + ms * NS_PER_MS))


def test_a_host_that_was_stopped_is_an_event_and_a_cure(world: World) -> None:
    watch, told = standstill(world, iter(lambda: 7.0, None))
    assert watch.cure() == ""
    passes(world, 3050)
    assert watch.cure().startswith(
        "this host stood still for 3.00 s: prevent it from being suspended or stopped"
    )
    assert told == [("this host stood still for 3.00 s: nothing was sent meanwhile", "WARN")]
    passes(world, 50)
    watch.attend()
    assert len(told) == 1


def test_a_machine_that_was_suspended_is_told_though_its_clock_stood_still(world: World) -> None:
    slept = count()
    watch, told = standstill(world, (7.0 if number < 22 else 12.5 for number in slept))
    passes(world, 50)
    assert watch.cure().startswith("this machine was suspended for 5.50 s: ")
    assert told == [("this machine was suspended for 5.50 s: nothing was sent meanwhile", "WARN")]


def test_what_ends_a_run_long_after_it_has_another_cause(world: World) -> None:
    watch, _ = standstill(world, iter(lambda: 7.0, None))
    passes(world, 3050)
    watch.attend()
    for _ in range(21):
        passes(world, 50)
        watch.attend()
    assert watch.cure() == ""


def test_a_run_in_simulated_time_stands_still_for_nobody(world: World) -> None:
    watch, told = standstill(replace(world, real_time=False), iter(lambda: 7.0, None))
    passes(world, 3050)
    assert watch.cure() == ""
    assert told == []


@pytest.mark.skipif("lxcfs" in Path("/proc/mounts").read_text(), reason="the uptime is a container's own")
def test_suspension_is_what_the_uptime_has_beyond_the_monotonic_clock() -> None:
    uptime_s = float(Path("/proc/uptime").read_text().split()[0])
    beyond_s = uptime_s - MonotonicClock().now() / NS_PER_S
    assert suspended() / NS_PER_S == pytest.approx(beyond_s, abs=1.0)
