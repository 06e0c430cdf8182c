"""The search for a running bus's rate, beside a clock and adapters that are made up."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import can
import pytest

from servobench.drivers.errors import BadInput, BusDown
from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.drivers.wire.adapters import BusSpec
from servobench.drivers.wire.attached import (
    CANDIDATES_BIT_S,
    LISTEN_NS,
    Detection,
    Heard,
    can_listen_only,
    detect_bitrate,
)

ADAPTER = BusSpec("pcan", "PCAN_USBBUS1")
FRAME, ERROR = can.Message(arbitration_id=0x701), can.Message(is_error_frame=True)


class Clock:
    """Stands still but for who listens."""

    at = Instant(1_000)

    def now(self) -> Instant:
        return self.at

    def sleep_until(self, instant: Instant) -> None:
        raise NotImplementedError


@dataclass
class Adapters:
    """At each rate: after how many seconds of silence what comes; a rate that is not there is refused."""

    clock: Clock
    comes: Mapping[int, list[tuple[float, can.Message]]]
    opened: list[int] = field(default_factory=list)
    closed: int = 0
    waits: list[float] = field(default_factory=list)

    def open_at(self, spec: BusSpec, bitrate_bit_s: int) -> can.BusABC:
        assert spec is ADAPTER
        self.opened.append(bitrate_bit_s)
        if bitrate_bit_s not in self.comes:
            raise can.CanInitializationError("the adapter refuses this rate")
        return Listening(self, list(self.comes[bitrate_bit_s]))


class Listening(can.BusABC):
    """One opened adapter."""

    def __init__(self, owner: Adapters, coming: list[tuple[float, can.Message]]) -> None:
        self._owner, self._coming = owner, coming

    def recv(self, timeout: float | None = None) -> can.Message | None:
        assert timeout is not None
        self._owner.waits.append(timeout)
        after, message = self._coming.pop(0) if self._coming else (1e9, FRAME)
        waited = min(after, timeout)
        self._owner.clock.at = Instant(self._owner.clock.at + round(waited * NS_PER_S))
        return message if after <= timeout else None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise AssertionError(f"who only listens sends {msg} within {timeout} s")

    def shutdown(self) -> None:
        self._owner.closed += 1

    def __del__(self) -> None:
        """Nothing was opened."""


def adapters(**comes: list[tuple[float, can.Message]]) -> Adapters:
    return Adapters(Clock(), {int(rate.removeprefix("at_")): coming for rate, coming in comes.items()})


def test_the_first_rate_with_two_frames_and_no_error_is_it() -> None:
    made = adapters(at_1000000=[(0.01, ERROR)], at_500000=[(0.1, FRAME), (0.2, FRAME), (0.0, ERROR)])
    began = made.clock.now()
    detection = detect_bitrate(ADAPTER, made.clock, made.open_at)
    assert detection == Detection(500_000, (Heard(1_000_000, 0, 1), Heard(500_000, 2, 0)))
    assert not detection.silent
    assert made.opened == [1_000_000, 500_000]
    assert made.closed == 2
    assert made.clock.now() - began == 310_000_000  # an error or the second frame ends it
    assert made.waits == pytest.approx([0.4, 0.4, 0.3])


def test_one_frame_is_not_enough_and_a_second_round_may_bring_more() -> None:
    made = adapters(at_125000=[(0.3, FRAME)])
    detection = detect_bitrate(ADAPTER, made.clock, made.open_at)
    assert detection == Detection(None, (Heard(125_000, 1, 0),))
    assert made.opened == 2 * list(CANDIDATES_BIT_S)  # a rate that the adapter lacks is passed over
    assert made.closed == 2
    assert made.clock.now() == 1_000 + 2 * LISTEN_NS


def test_frames_with_an_error_among_them_are_those_of_another_rate() -> None:
    made = adapters(at_250000=[(0.0, FRAME), (0.0, ERROR)], at_125000=[])
    detection = detect_bitrate(ADAPTER, made.clock, made.open_at, (250_000, 125_000), Duration(50))
    assert detection == Detection(None, (Heard(250_000, 1, 1), Heard(125_000, 0, 0)))
    assert not detection.silent


def test_silence_at_every_rate_is_told() -> None:
    made = adapters(at_20000=[], at_10000=[])
    assert detect_bitrate(ADAPTER, made.clock, made.open_at, (20_000, 10_000)).silent


def test_rates_are_tried_as_devices_are_usually_set() -> None:
    assert CANDIDATES_BIT_S == (
        1_000_000, 500_000, 250_000, 125_000, 800_000, 100_000, 50_000, 20_000, 10_000
    )  # fmt: skip


@pytest.mark.parametrize(
    ("interface", "can_listen"),
    [("slcan", True), ("pcan", True), ("kvaser", True), ("socketcan", False), ("hub", False)],
)
def test_who_can_only_listen(interface: str, can_listen: bool) -> None:
    assert can_listen_only(BusSpec(interface, "one")) is can_listen


def test_an_adapter_that_cannot_only_listen_is_not_opened() -> None:
    made = adapters()
    with pytest.raises(BadInput) as caught:
        detect_bitrate(BusSpec("socketcan", "can0"), made.clock, made.open_at)
    assert str(caught.value) == (
        "--bus: found 'socketcan:can0', expected an adapter that can only listen: kvaser, pcan, slcan; "
        "give --bitrate"
    )
    assert made.opened == []


def _fails_with(error: Exception) -> Callable[[BusSpec, int], can.BusABC]:
    def open_at(_spec: BusSpec, _bitrate: int) -> can.BusABC:
        raise error

    return open_at


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (can.CanInitializationError("no driver"), "cannot open pcan:PCAN_USBBUS1; no driver"),
        (FileNotFoundError("no port"), "cannot open pcan:PCAN_USBBUS1; no port; check the port's name"),
    ],
)
def test_an_adapter_that_does_not_open_ends_the_search(error: Exception, told: str) -> None:
    with pytest.raises(BusDown) as caught:
        detect_bitrate(ADAPTER, Clock(), _fails_with(error))
    assert str(caught.value) == told


def test_an_adapter_that_fails_while_it_listens_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    made = adapters(at_1000000=[])

    def fail(_self: Listening, timeout: float | None = None) -> can.Message | None:
        raise can.CanOperationError(f"unplugged within {timeout} s")

    monkeypatch.setattr(Listening, "recv", fail)
    with pytest.raises(BusDown) as caught:
        detect_bitrate(ADAPTER, made.clock, made.open_at)
    assert str(caught.value) == "pcan:PCAN_USBBUS1 failed while it listened; unplugged within 0.4 s"
    assert made.closed == 1
