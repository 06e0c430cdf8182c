"""The frame, and the taps of a link, as Python sees what is C of them (drivers/core)."""

import pytest

from servobench.drivers.core.native import data_frame
from servobench.drivers.record import values_of
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import UNTOLD, FramePort, FrameTap, WireFrame
from servobench.drivers.wire.link import BusLink
from servobench.virtual_bus.core.native import SimulatedClock, Timeline


def test_equal_by_every_field_but_the_hand_over() -> None:
    frame = WireFrame(0x181, b"\x01")
    other = WireFrame(data=b"\x01", can_id=0x181)
    other.handed_at = Instant(7)
    assert frame.handed_at == UNTOLD
    assert frame == other
    assert hash(frame) == hash(other)
    assert data_frame(0x181, b"\x01") == frame
    for changed in (
        WireFrame(0x182, b"\x01"),
        WireFrame(0x181, b"\x02"),
        WireFrame(0x181, b"\x01", True),
        WireFrame(0x181, b"\x01", remote=True),
        WireFrame(0x181, b"\x01", remote_length=1),
    ):
        assert changed != frame
    assert frame != values_of(frame)


def test_shown_with_its_fields() -> None:
    frame = WireFrame(0x181, b"\x01", remote_length=3)
    assert repr(frame) == (
        "WireFrame(can_id=385, data=b'\\x01', extended=False, remote=False, remote_length=3)"
    )
    assert values_of(frame) == (0x181, b"\x01", False, False, 3)


@pytest.mark.parametrize("given", [("1",), (1, "data"), (1, b"", False, False, None), ()])
def test_other_types_are_refused(given: tuple[object, ...]) -> None:
    with pytest.raises(TypeError):
        WireFrame(*given)  # type: ignore[arg-type]


def test_the_fields_stay_as_they_are() -> None:
    with pytest.raises(AttributeError):
        WireFrame(1).can_id = 2  # type: ignore[misc]


def test_more_taps_than_a_link_has_places_for_are_refused() -> None:
    clock = SimulatedClock(Timeline())
    bus = type("Bus", (), {"frame_port": FramePort()})()
    link = BusLink(bus, clock)
    for _ in range(16):
        link.tap(FrameTap())
    with pytest.raises(ValueError, match="16 taps"):
        link.tap(FrameTap())


def test_what_is_no_frame_is_refused() -> None:
    class Port(FramePort):
        def receive(self, until: Instant) -> WireFrame | None:  # noqa: ARG002
            return b"no frame"  # type: ignore[return-value]

    link = BusLink(type("Bus", (), {"frame_port": Port()})(), SimulatedClock(Timeline()))
    with pytest.raises(TypeError, match="WireFrame"):
        link.fetch(Instant(1))
