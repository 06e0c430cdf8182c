"""What the native bus owes Python: the order of events, errors of callbacks, and no garbage that stays."""

import gc
import weakref
from functools import partial
from heapq import heappop, heappush

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import Duration, Instant
from servobench.virtual_bus.bus.host_port import HostPort
from servobench.virtual_bus.bus.judge import Direction, Judge
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.core.native import Port, Segment
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import Timeline
from tests.draws import examples_of
from tests.hearing import Hearing

MS = 1_000_000


def _note(happened: list[tuple[int, int]], order: int, now: Instant) -> None:
    happened.append((now, order))


@examples_of(300)
@given(st.lists(st.one_of(st.none(), st.integers(0, 20))))
def test_events_come_by_instant_and_then_in_the_order_of_entry(steps: list[int | None]) -> None:
    """``steps``: after how long an event is entered, or None to run the next."""
    timeline, reference, happened, expected = Timeline(), list[tuple[int, int]](), list[tuple[int, int]](), []
    for order, after in enumerate(steps):
        if after is not None:
            when = Instant(timeline.now + after)
            timeline.post(when, partial(_note, happened, order))
            heappush(reference, (when, order))
        else:
            assert timeline.step() == bool(reference)
            expected += [heappop(reference)] if reference else []
    while timeline.step():
        expected.append(heappop(reference))
    assert happened == expected
    assert not reference


def _refuse(frame: Frame, now: Instant) -> None:
    raise LookupError(frame.can_id, now)


def test_what_a_listener_raises_comes_out_and_the_next_frame_still_goes() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    heard: list[int] = []
    sender = segment.attach("sender", Listener())
    segment.attach("refuses", Hearing(_refuse))
    other = segment.attach("other", Hearing(lambda frame, _now: heard.append(frame.can_id)))
    sender.send(Frame(1))
    other.send(Frame(2))
    for can_id in (1, 2):
        with pytest.raises(LookupError) as raised:
            timeline.run_until(Instant(MS))
        assert raised.value.args == (can_id, timeline.now)
    timeline.run_until(Instant(MS))
    assert (segment.frames, timeline.now, timeline.next_at()) == (2, MS, None)


class Refusing(Judge):
    def hold(self, way: int, can_id: int, now: Instant, extended: bool) -> int:  # noqa: ARG002
        if can_id == 1:
            raise LookupError("no fate")
        return -1

    def replacements(self, frame: Frame) -> list[tuple[Frame, Duration]]:
        raise LookupError(f"nothing for {frame.can_id}")


def test_what_a_judge_raises_comes_out_of_transmit_and_of_receive() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    host, peer = HostPort(segment, "host"), segment.attach("peer", Listener())
    host.put_before(Refusing(), Direction.HOST_TO_DRIVE)
    with pytest.raises(LookupError, match="no fate"):
        host.transmit(Frame(1))
    peer.send(Frame(2))
    with pytest.raises(LookupError, match="nothing for 2"):
        host.receive(Instant(MS))
    assert host.receive(Instant(MS)) is None


def test_a_frame_that_is_none_is_refused_and_nothing_is_queued() -> None:
    port = CanSegment(Timeline()).attach("port", Listener())
    for frame in (
        Frame(1, bytes(9)),
        Frame(-1),
        Frame(1 << 29, extended=True),
        Frame(1, remote=True, remote_length=16),
    ):
        with pytest.raises(ValueError, match="expected"):
            port.send(frame)
    assert port.pending == 0


def test_the_queue_is_the_segments_as_long_as_nothing_goes_wrong() -> None:
    port = CanSegment(Timeline()).attach("port", Listener())
    port.send(Frame(1))
    for take in (port.take_head, port.clear):
        with pytest.raises(ValueError, match="not in charge"):
            take()
    assert port.pending == 1


def test_a_port_of_another_class_is_refused() -> None:
    timeline = Timeline()
    with pytest.raises(TypeError):
        Port(timeline, 1, "port", Listener())  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        Segment(timeline, 1).add_port(timeline)  # type: ignore[arg-type]


def test_a_port_that_hears_only_some_gets_no_others() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    got: list[Frame] = []
    sender = segment.attach("sender", Listener())
    hears = {5: "of interest"}
    segment.attach("some", Hearing(lambda frame, _now: got.append(frame))).hear_only(hears, None)
    sent = [Frame(5), Frame(6), Frame(5, extended=True), Frame(6, remote=True, remote_length=1), Frame(7)]
    for frame in sent:
        if frame.can_id == 7:
            hears[7] = "of interest from now on"
        sender.send(frame)
        timeline.run_until(Instant(timeline.now + MS))
    assert got == [sent[0], sent[3], sent[4]]


def _make_world(acknowledged: bool) -> list[weakref.ref[object]]:
    """Frames in every queue, events to come, and callbacks that lead back to all of it."""
    timeline = Timeline()
    segment = CanSegment(timeline, acknowledged=acknowledged)
    host = HostPort(segment, "host")
    host.hear_itself()
    host.put_before(Judge(), Direction.HOST_TO_DRIVE)
    port = segment.attach("port", Hearing(lambda _frame, _now: port.send(Frame(1))))
    port.on_sent = lambda frame, _now: port.send(frame)
    for number in range(3):
        port.send(Frame(number))
    timeline.call_at(Instant(MS), lambda _now: host.close())
    return [weakref.ref(each) for each in (segment, port, host.port)]


@pytest.mark.parametrize("acknowledged", [False, True])
def test_a_world_that_nobody_holds_is_collected(acknowledged: bool) -> None:
    gone = _make_world(acknowledged)
    gc.collect()
    assert [reference() for reference in gone] == [None, None, None]


def test_a_detached_port_says_so() -> None:
    port = CanSegment(Timeline()).attach("port", Listener())
    port.detach()
    with pytest.raises(can.CanOperationError, match="detached"):
        port.send(Frame(1))
