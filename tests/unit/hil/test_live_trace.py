"""The frames of a bus while somebody listens, on one within this process."""

from collections.abc import Callable, Generator
from contextlib import closing
from itertools import count, islice
from typing import Any, Final

import can
import pytest

from servobench.drivers.errors import BadInput, BusDown
from servobench.drivers.timebase import Duration
from servobench.drivers.wire.adapters import OpenBus, parse_bus_spec
from servobench.drivers.wire.link import StampSource
from servobench.hil.inspecting import live_trace
from servobench.hil.inspecting.live_trace import live_frames
from servobench.hil.inspecting.scanning import OpenedBus, ScanPlan
from servobench.hil.reviewing.trace.frame_columns import LogFrame
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.bus.hub_protocol import HubStatus

_channels: Final = count()
SPEC: Final = parse_bus_spec("virtual:looked-at")


class Listened:
    """A bus on which another node sends ``messages`` as soon as somebody listens."""

    def __init__(self, *messages: can.Message) -> None:
        self.spec = parse_bus_spec(f"virtual:live-{next(_channels)}")
        self.said: list[str] = []
        self._messages = messages
        self._other = can.Bus(interface="virtual", channel=self.spec.channel)

    def say(self, text: str) -> None:
        self.said.append(text)
        for message in self._messages:
            self._other.send(message)

    def frames(self, number: int) -> list[LogFrame]:
        with self._other, closing(live_frames(self.spec, 500_000, lambda: False, self.say)) as frames:
            return list(islice(frames, number))


def message(can_id: int, data: bytes = b"", **more: Any) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **more})


def test_each_frame_is_told_with_its_number_and_kind() -> None:
    listened = Listened(
        message(0x181, b"\1\2"),
        message(0x1ABC_DEF0, b"\3", is_extended_id=True),
        message(0x701, is_remote_frame=True),
        message(0x0A4, bytes(range(8)), is_error_frame=True),
        message(0x7FF, bytes(8)),
    )
    frames = listened.frames(5)
    channel = str(listened.spec)
    assert [frame._replace(at_ns=None) for frame in frames] == [
        LogFrame(1, None, channel, 0x181, b"\1\2", sent="R"),
        LogFrame(2, None, channel, 0x1ABC_DEF0, b"\3", extended=True, sent="R"),
        LogFrame(3, None, channel, 0x701, b"", remote=True, sent="R"),
        LogFrame(4, None, channel, 0x0A4, bytes(range(8)), error=True, sent="R"),
        LogFrame(5, None, channel, 0x7FF, bytes(8), sent="R"),
    ]
    assert listened.said == [f"listening on {channel}; Ctrl-C ends it"]


class Bus(can.BusABC):
    """What comes to whoever receives: an error, or nothing."""

    def __init__(self, events: list[Exception | None]) -> None:
        super().__init__(channel="looked-at")
        self.events = events
        self.closed = 0

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise AssertionError(f"{msg} {timeout}: nothing is sent")

    def recv(self, timeout: float | None = None) -> can.Message | None:
        assert timeout is not None
        assert 0.0 < timeout <= 0.1, "a stop is not kept waiting"
        event = self.events.pop(0)
        if event is not None:
            raise event
        return None

    def shutdown(self) -> None:
        self.closed += 1
        super().shutdown()


def opened(
    monkeypatch: pytest.MonkeyPatch, bus: can.BusABC
) -> Callable[[Callable[[], bool]], Generator[LogFrame, None, None]]:
    """Whoever listens has ``bus``."""

    def look(plan: ScanPlan, _say: Callable[[str], None]) -> OpenedBus:
        assert plan == ScanPlan(SPEC, 250_000, Duration(0), passive=True)
        return OpenedBus(OpenBus(bus, StampSource.RECEIPT, str(SPEC)), 250_000, False)

    monkeypatch.setattr(live_trace, "open_to_look", look)
    return lambda stopped: live_frames(SPEC, 250_000, stopped, lambda _text: None)


def test_on_a_silent_bus_it_is_looked_for_a_stop_time_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Bus([None] * 3)
    assert list(opened(monkeypatch, bus)(lambda: not bus.events)) == []
    assert bus.closed == 1


def test_a_stop_that_has_come_before_is_heard_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Bus([])
    assert list(opened(monkeypatch, bus)(lambda: True)) == []
    assert bus.closed == 1


@pytest.mark.parametrize("error", [can.CanOperationError("it is unplugged"), OSError("it is unplugged")])
def test_a_bus_that_goes_away_is_named_and_closed(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    bus = Bus([None, error])
    with pytest.raises(BusDown) as caught:
        list(opened(monkeypatch, bus)(lambda: False))
    assert str(caught.value) == f"{SPEC} failed while it was listened to; it is unplugged"
    assert bus.closed == 1


def test_who_ends_the_listening_closes_the_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    with can.Bus(interface="virtual", channel="left") as other:
        bus = can.Bus(interface="virtual", channel="left")
        frames = opened(monkeypatch, bus)(lambda: False)
        other.send(message(0x80))
        assert next(frames).can_id == 0x80
        frames.close()
        with pytest.raises(can.CanOperationError):
            bus.send(message(0x80))


def test_the_simulated_bus_cannot_be_listened_to() -> None:
    with pytest.raises(BadInput) as caught:
        next(live_frames(parse_bus_spec("simulated"), None, lambda: False, print))
    error = caught.value
    assert (error.source, error.key, error.value) == ("--bus", "", "simulated")
    assert (error.expected, error.remedy) == ("a bus that other processes can join", "use hub:NAME")


class OnlyListens(HubBus):
    """An end of a hub that notes how it is used."""

    def __init__(self) -> None:
        self.noted: list[str] = []

    def set_listen_only(self, on: bool) -> HubStatus:
        self.noted.append(f"listens only: {on}")
        return HubStatus(ErrorState.ACTIVE, 0, 0, True, on, 0, 0, False)

    def shutdown(self) -> None:
        self.noted.append("closed")


def test_on_a_hub_it_listens_only(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = OnlyListens()
    bus.frame_port = None  # type: ignore[assignment]
    assert list(opened(monkeypatch, bus)(lambda: True)) == []
    assert bus.noted == ["listens only: True", "closed"]
