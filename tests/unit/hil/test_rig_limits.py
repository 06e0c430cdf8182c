"""The drive of the pytest plugin on other buses than its own, and what its claims tell of emergencies."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.hil.testing import drive_rig as module
from servobench.hil.testing.drive_rig import DriveRig, drive_rig
from servobench.hil.testing.hosted import DriveHost, DriveWish

Make = Callable[..., DriveRig]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    with ExitStack() as stack:
        host = DriveHost("simulated", tmp_path)
        yield lambda **wish: stack.enter_context(drive_rig("simulated", host, DriveWish(**wish)))


def test_a_state_is_looked_for_each_five_milliseconds(make: Make) -> None:
    rig = make()
    rig.configure()
    looks: list[int] = []

    def state() -> State:
        looks.append(rig.clock.now())
        return State.FAULT if len(looks) > 4 else State.SWITCHED_ON

    rig.state = state  # type: ignore[method-assign]
    assert rig.assert_reaches(State.FAULT, within_s=0.02) == pytest.approx(0.02)
    assert [at - looks[0] for at in looks] == [5 * NS_PER_MS * n for n in range(5)]
    looks.clear()
    with pytest.raises(
        AssertionError, match=r"^node 1: not in 'fault' after 0.0149 s; it was in 'switched on'$"
    ):
        rig.assert_reaches(State.FAULT, within_s=0.0149)
    looks.clear()
    with pytest.raises(
        AssertionError, match=r"^node 1: 'fault' after 0.020 s, to stay in 'switched on' for 0.03 s$"
    ):
        rig.assert_stays(State.SWITCHED_ON, for_s=0.03)
    looks.clear()
    rig.assert_stays(State.SWITCHED_ON, for_s=0.02)
    assert len(looks) == 4


def test_no_state_of_cia_402_is_told_as_such(make: Make) -> None:
    rig = make()
    rig.state = lambda: None  # type: ignore[method-assign]
    nothing = "no state of CiA 402"
    with pytest.raises(AssertionError) as caught:
        rig.assert_reaches(State.FAULT, within_s=0.01)
    assert str(caught.value) == f"node 1: not in 'fault' after 0.01 s; it was in '{nothing}'"
    with pytest.raises(AssertionError) as caught:
        rig.assert_stays(State.FAULT, for_s=0.01)
    assert str(caught.value) == f"node 1: {nothing} after 0.000 s, to stay in 'fault' for 0.01 s"


def test_the_last_emergencies_of_the_drive_are_told(make: Make) -> None:
    rig = make()
    told = [(1, 0x8130), (1, 0x2310), (2, 0x5000), (1, 0x7121), (1, 0x3210)]
    rig.network.emergencies.extend(SimpleNamespace(node_id=node, code=code) for node, code in told)  # type: ignore[misc]
    text = rig._emergencies()
    assert text.startswith("; EMCY: 2310h ")
    assert [part.split()[0] for part in text.removeprefix("; EMCY: ").split(", ")] == [
        "2310h",
        "7121h",
        "3210h",
    ]
    rig.network.emergencies.clear()
    assert rig._emergencies() == ""


def test_a_rig_in_real_time_asks_its_drive_for_little(make: Make) -> None:
    rig = make()
    rig._live = True
    assert rig.period == rig.settings.sync_period_ns == 10 * NS_PER_MS
    rig.enable()
    assert len(rig.run(0.1)) == 10


def test_a_run_is_as_many_cycles_as_its_time_holds(make: Make) -> None:
    rig = make()
    rig.enable()
    began = rig.clock.now()
    assert len(rig.run(0.0104)) == 10
    assert len(rig.run(0.0106)) == 11
    assert rig.clock.now() - began == 21 * NS_PER_MS
    assert rig.run(0.0) == []


def test_a_rig_is_configured_once_unless_something_changes(make: Make) -> None:
    rig = make()
    rig.enable()
    assert rig.device is not None
    rated = 1000 * 1.0 / rig.motor.rating.torque_nm
    sent = len(rig.wire.frames)
    rig.client.disable(rig.deadline(1.0))
    rig.enable(torque_max_nm=1.0)
    assert rig.device.dictionary.variable(0x6072).value == round(rated)
    assert len(rig.wire.frames) > sent


class World:
    """No bus: what was asked of it."""

    def __init__(self, plan: Any, devices: list[Any]) -> None:
        self.plan, self.devices = plan, devices
        self.events: list[str] = []
        self.clock = SimpleNamespace(now=lambda: 5 * NS_PER_S)
        self.faults = SimpleNamespace(
            start=lambda at: self.events.append(f"faults from {at}"),
            stop=lambda: self.events.append("faults end"),
        )

    def __enter__(self) -> "World":
        return self

    def __exit__(self, *_: object) -> None:
        self.events.append("closed")


class Rig:
    """No drive."""

    def __init__(self, world: World, *given: Any) -> None:
        self.world, self.given = world, given

    def release(self) -> None:
        self.world.events.append("released")


@pytest.fixture
def no_world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "open_world", World)
    monkeypatch.setattr(module, "DriveRig", Rig)


class Host:
    """Drives that are there, and those that were started."""

    def __init__(self, *there: int) -> None:
        self.there = there
        self.started: list[Any] = []

    def missing(self, nodes: list[int]) -> list[int]:
        return [node for node in nodes if node not in self.there]

    def start(self, nodes: list[int], wish: DriveWish) -> str:
        self.started.append((nodes, wish))
        return "its process"


@pytest.mark.usefixtures("no_world")
def test_in_real_time_a_drive_that_is_not_there_is_started() -> None:
    wish = DriveWish(node=4, seed=9, bitrate_bit_s=250_000, faults={"loss": [{"probability": 0.5}]})
    host: Any = Host()
    with drive_rig("hub:x", host, wish) as rig:
        made: Any = rig
        assert host.started == [([4], wish)]
        assert made.given == (wish, None, "its process")
        plan = made.world.plan
        assert (plan.spec.simulated, plan.bitrate_bit_s, plan.seed) == (False, 250_000, 9)
        assert made.world.devices == []
        assert plan.faults is None, "they are of the process"
    assert made.world.events == [f"faults from {5 * NS_PER_S}", "faults end", "released", "closed"]
    there: Any = Host(4)
    with drive_rig("hub:x", there, wish) as rig:
        again: Any = rig
        assert again.given == (wish, None, None)
    assert there.started == []


@pytest.mark.usefixtures("no_world")
def test_a_simulated_drive_is_in_its_world_with_its_faults() -> None:
    wish = DriveWish(node=4, seed=9, faults={"loss": [{"probability": 0.5}]})
    host: Any = Host()
    with drive_rig("simulated", host, wish) as rig:
        made: Any = rig
        (device,) = made.world.devices
        assert made.given == (wish, device, None)
        assert made.world.plan.faults is not None
        assert made.world.plan.seed == 9
    assert host.started == []
    assert made.world.events == [f"faults from {5 * NS_PER_S}", "faults end", "released", "closed"]


@pytest.mark.usefixtures("no_world")
def test_a_rig_is_released_whatever_the_test_raises() -> None:
    host: Any = Host(1)
    made = drive_rig("hub:x", host, DriveWish())
    rig: Any = made.__enter__()
    assert made.__exit__(RuntimeError, RuntimeError("of the test"), None) is False
    assert rig.world.events[1:] == ["faults end", "released", "closed"]
