"""A session of commissioning: when it enables, what makes it stop, and how the drive is left."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any, cast

import pytest

from servobench.drivers.errors import BusDown, DriveInFault, NoAnswer
from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.hil.commissioning.dialog import EmergencyStop
from servobench.hil.commissioning.findings import StepFailed
from servobench.hil.commissioning.request import Nameplate
from servobench.hil.commissioning.session import EmergencyStopped, Session
from servobench.hil.machine.stopping import Interrupted


class Stop:
    """Stands in for the keyboard and the signals."""

    def __init__(self, notes: list[str]) -> None:
        self.asked = self.key = False
        self.asked_by = "SIGTERM"
        self._notes = notes

    def __call__(self) -> bool:
        return self.asked

    @contextmanager
    def armed(self) -> Iterator[None]:
        self._notes.append("armed")
        try:
            yield
        finally:
            self._notes.append("disarmed")


class Drive:
    """Notes what it is told, and fails where it is told to."""

    def __init__(self, notes: list[str]) -> None:
        self.failure: Exception | None = None
        self.stopping: Exception | None = None
        self._notes = notes

    def enable(self, deadline: Duration) -> None:
        self._notes.append(f"enable within {deadline / NS_PER_S:g} s")
        if self.failure is not None:
            raise self.failure

    def quick_stop(self, deadline: Duration) -> None:
        self._notes.append(f"quick stop within {deadline / NS_PER_S:g} s")
        if self.stopping is not None:
            raise self.stopping


class Bench:
    """A session whose drive, keyboard and user are stand-ins."""

    def __init__(self, nameplate: dict[str, Any] | None = None, raw_temperature: int | None = 0) -> None:
        self.notes: list[str] = []
        self.told: list[str] = []
        self.stop = Stop(self.notes)
        self.drive = Drive(self.notes)
        session = Session.__new__(Session)
        session.stop = cast(EmergencyStop, self.stop)
        session.drive = cast(Any, self.drive)
        session.drives = cast(
            Any, SimpleNamespace(enable=lambda drive, limit_s: drive.enable(round(limit_s * NS_PER_S)))
        )
        session.dialog = cast(Any, SimpleNamespace(tell=self.told.append))
        session.network = cast(Any, SimpleNamespace(deadline_after=lambda duration: duration))
        session.gaps = cast(Any, SimpleNamespace(while_enabled=nullcontext))
        session._port = cast(Any, SimpleNamespace())
        session.request = cast(Any, SimpleNamespace(nameplate=Nameplate.model_validate(nameplate or {})))
        session.objects = cast(Any, SimpleNamespace(read_if_there=self._read))
        self.session = session
        self.asked: tuple[int, int] | None = None
        self._raw = raw_temperature

    def _read(self, index: int, sub: int, _code: str) -> int | None:
        self.notes.append("temperature")
        self.asked = index, sub
        return self._raw


def test_a_drive_is_enabled_with_a_key_at_hand_and_stopped_afterwards() -> None:
    bench = Bench()
    with bench.session.enabled():
        bench.notes.append("turning")
    assert bench.notes == [
        "armed", "enable within 3 s", "turning", "quick stop within 5 s", "disarmed"
    ]  # fmt: skip


@pytest.mark.parametrize("at", ["enabling", "turning"])
def test_whatever_fails_the_drive_is_stopped(at: str) -> None:
    bench = Bench()
    if at == "enabling":
        bench.drive.failure = DriveInFault("it failed")
    with pytest.raises(DriveInFault, match="it failed"), bench.session.enabled():
        raise DriveInFault("it failed")
    assert bench.notes[-2:] == ["quick stop within 5 s", "disarmed"]


def test_a_stop_request_while_it_turned_is_passed_on_after_the_stop() -> None:
    bench = Bench()
    with pytest.raises(Interrupted), bench.session.enabled():
        bench.stop.asked = True
    assert bench.notes[-2:] == ["quick stop within 5 s", "disarmed"]


def test_what_a_drive_says_against_its_stop_is_told_but_a_lost_bus_is_raised() -> None:
    bench = Bench()
    bench.drive.stopping = NoAnswer("it does not answer")
    bench.session.calm()
    assert "while stopping: it does not answer" in bench.told[0]
    bench.drive.stopping = BusDown("the adapter is gone")
    with pytest.raises(BusDown):
        bench.session.calm()
    assert len(bench.told) == 1


def test_a_key_is_an_emergency_stop_and_a_signal_an_end() -> None:
    bench = Bench()
    bench.session.check_stop()
    bench.stop.asked = True
    with pytest.raises(Interrupted, match="ended by SIGTERM") as caught:
        bench.session.check_stop()
    assert not isinstance(caught.value, EmergencyStopped)
    bench.stop.key = True
    with pytest.raises(EmergencyStopped, match="key") as stopped:
        bench.session.check_stop()
    assert stopped.value.exit_status == 3


PLATE = {"temperature": {"index": 0x2030, "sub": 4, "celsius": 0.1}, "limits": {"temperature_max_c": 70.0}}


def test_a_hot_drive_is_not_enabled() -> None:
    bench = Bench(PLATE, raw_temperature=701)
    with pytest.raises(StepFailed, match=r"70\.1 C"), bench.session.enabled():
        pass
    assert bench.notes == ["temperature"]
    assert bench.asked == (0x2030, 4)


def test_a_drive_at_its_temperature_limit_is_enabled_and_so_is_a_cold_one() -> None:
    for raw in (700, 0, -200):
        bench = Bench(PLATE, raw_temperature=raw)
        with bench.session.enabled():
            pass
        assert bench.notes[:2] == ["temperature", "armed"]


def test_a_temperature_that_cannot_be_read_keeps_the_drive_disabled() -> None:
    bench = Bench(PLATE, raw_temperature=None)
    with pytest.raises(StepFailed, match="2030h:04 tells no temperature"), bench.session.enabled():
        pass
    assert bench.notes == ["temperature"]


def test_without_a_limit_s_object_no_temperature_is_asked_for() -> None:
    bench = Bench(None, raw_temperature=None)
    bench.session.check_temperature()
    assert bench.asked is None
