"""What looks after a recording while its loop runs: confirmed before anything moves, and trouble is told."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.recording import logger_process as module
from servobench.hil.recording.logger_process import RecordingFailed, RecordingWatch
from servobench.hil.recording.run_recorder import RunRecorder
from servobench.virtual_bus.timeline import SimulatedClock, Timeline

NOW: Final = Instant(5 * NS_PER_MS)


class World:
    """A recorder, a bus and a clock, and all that is asked of them."""

    def __init__(self) -> None:
        self.log: list[tuple[object, ...]] = []
        self.said: list[str] = []
        """What the recorder has to tell of trouble, question by question."""

    def confirm(self, wait: Callable[[], None]) -> None:
        self.log.append(("confirm",))
        wait()
        wait()

    def trouble(self) -> str:
        self.log.append(("asked",))
        return self.said.pop(0)

    def now(self) -> Instant:
        return NOW

    def sleep_until(self, at: Instant) -> None:
        self.log.append(("sleep", at))

    def pump(self, until: Instant) -> None:
        self.log.append(("pump", until))

    def progress(self, phase: str, elapsed_s: float) -> None:
        self.log.append(("progress", phase, elapsed_s))

    def say(self, text: str, level: str) -> None:
        self.log.append(("say", text, level))

    def watch(self, goes_on: bool = False) -> RecordingWatch:
        return RecordingWatch(cast(RunRecorder, self), goes_on, self.progress, self.say)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    found = World()
    monkeypatch.setattr(module, "MonotonicClock", lambda: found)
    return found


@pytest.mark.parametrize(
    ("clock", "serves"), [(SimulatedClock(Timeline()), "sleep"), (SimpleNamespace(), "pump")]
)
def test_simulated_time_stands_still_while_the_logger_stores_and_a_real_bus_is_served(
    world: World, clock: Any, serves: str
) -> None:
    network = SimpleNamespace(clock=clock, pump=world.pump)
    world.watch().confirm(cast(CanopenNetwork, network))
    assert world.log == [("confirm",), *[(serves, NOW + NS_PER_MS)] * 2]


def test_a_recording_without_trouble_is_asked_each_time_and_said_nothing_of(world: World) -> None:
    world.said = ["", ""]
    watch = world.watch()
    watch.attend(0.25)
    watch.attend(0.5)
    asked = ("asked",)
    assert world.log == [asked, ("progress", "running", 0.25), asked, ("progress", "running", 0.5)]


def test_trouble_ends_the_run_after_it_was_shown(world: World) -> None:
    world.said = ["", "the disk is full"]
    watch = world.watch()
    watch.attend(0.25)
    with pytest.raises(RecordingFailed) as caught:
        watch.attend(0.5)
    assert str(caught.value) == "not recorded: the disk is full"
    assert world.log[-1] == ("progress", "not recorded: the disk is full", 0.5)


def test_a_run_that_goes_on_tells_of_it_once_and_shows_it_to_the_end(world: World) -> None:
    world.said = ["the disk is full"]
    watch = world.watch(goes_on=True)
    watch.attend(0.5)
    watch.attend(0.75)
    phase = "not recorded: the disk is full"
    assert world.log == [
        ("asked",),
        ("progress", phase, 0.5),
        ("say", phase, "CRITICAL"),
        ("progress", phase, 0.75),
    ]
