"""Arbitration, spacing, delivery and load of one segment."""

import random
from collections.abc import Callable

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import NS_PER_US, Instant
from servobench.virtual_bus.bus.port import TRANSMIT_QUEUE_MAX, Listener, OnFrame
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import Timeline
from tests.draws import examples_of
from tests.hearing import Hearing
from tests.unit.virtual_bus.can_reference import random_frame, unstuffed_fields
from tests.unit.virtual_bus.can_reference import wire_bits as reference_wire_bits

EXAMPLES = examples_of(100)

Submission = tuple[int, int, Frame]
"""Instant in ns, port, frame."""


def sender_of(send: Callable[[Frame], None], frame: Frame) -> Callable[[Instant], None]:
    return lambda _now: send(frame)


def run(submissions: list[Submission], ports: int, bitrate: int = 1_000_000) -> list[tuple[int, Frame]]:
    """Every frame with its end of frame, as a monitor sees them."""
    timeline = Timeline()
    segment = CanSegment(timeline, bitrate)
    attached = [segment.attach(f"port{number}", Listener()) for number in range(ports)]
    seen: list[tuple[int, Frame]] = []
    segment.add_monitor(lambda frame, at: seen.append((at, frame)))
    for when, port, frame in submissions:
        timeline.post(Instant(when), sender_of(attached[port].send, frame))
    while timeline.step():
        pass
    return seen


def arbitration_bits(frame: Frame) -> str:
    """Start of frame to IDE (standard) or RTR (extended); what follows is no longer contested."""
    return unstuffed_fields(frame)[: 33 if frame.extended else 14]


def oracle(submissions: list[Submission], ports: int, bitrate: int = 1_000_000) -> list[tuple[int, Frame]]:
    """The same by exhaustive search: at each start the lowest bit string among the heads of the queues."""
    waiting = [sorted((s for s in submissions if s[1] == port), key=lambda s: s[0]) for port in range(ports)]
    ended: list[tuple[int, Frame]] = []
    free_at = 0
    while any(waiting):
        start = max(free_at, min(queue[0][0] for queue in waiting if queue))
        heads = [(arbitration_bits(q[0][2]), q[0][1]) for q in waiting if q and q[0][0] <= start]
        winner = min(heads)[1]
        frame = waiting[winner].pop(0)[2]
        bits = len(reference_wire_bits(frame))
        end = start - (-bits * 1_000_000_000 // bitrate)
        ended.append((end, frame))
        free_at = end - (-3 * 1_000_000_000 // bitrate)
    return ended


often_used = st.builds(
    lambda can_id, data: Frame(can_id, data),
    st.sampled_from([0x000, 0x080, 0x181, 0x182, 0x281, 0x7FF]),
    st.sampled_from([b"", b"\x00" * 8, b"\xff\x00\x12"]),
)
frames = often_used | st.integers(0, 1 << 16).map(lambda seed: random_frame(random.Random(seed)))


@EXAMPLES
@given(st.lists(st.tuples(st.integers(0, 500_000), st.integers(0, 3), frames), max_size=25))
def test_sequence_and_instants_match_exhaustive_arbitration(submissions: list[Submission]) -> None:
    assert run(submissions, 4) == oracle(submissions, 4)


@EXAMPLES
@given(
    st.lists(st.tuples(st.sampled_from([0, 47_000, 94_000]), st.integers(0, 3), frames), max_size=12),
    st.sampled_from([10_000, 83_333, 125_000, 500_000, 800_000]),
)
def test_same_at_any_bit_rate_and_when_frames_coincide(submissions: list[Submission], bitrate: int) -> None:
    assert run(submissions, 4, bitrate) == oracle(submissions, 4, bitrate)


@EXAMPLES
@given(st.permutations(list(range(6))))
def test_order_of_events_within_an_instant_does_not_matter(order: list[int]) -> None:
    submissions = [(0, port, Frame(0x600 - 0x80 * port, bytes([port]))) for port in range(6)]
    permuted = [submissions[number] for number in order]
    assert run(permuted, 6) == run(submissions, 6)
    assert [frame.can_id for _, frame in run(permuted, 6)] == sorted(0x600 - 0x80 * n for n in range(6))


def test_standard_before_extended_and_data_before_remote() -> None:
    base = 0x123
    contest = [
        Frame((base << 18) | 1, b"", True, True),
        Frame((base << 18) | 1, b"", True),
        Frame(base << 18, b"", True),
        Frame(base, b"", False, True),
        Frame(base, b"\x01"),
        Frame(base - 1, b"", False, True),
    ]
    seen = run([(0, port, frame) for port, frame in enumerate(contest)], len(contest))
    assert [frame for _, frame in seen] == contest[::-1]


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_same_identifier_at_the_same_time_goes_by_the_order_of_the_ports(order: tuple[int, ...]) -> None:
    seen = run([(0, port, Frame(0x100, bytes([port]))) for port in order], 3)
    assert [frame.data[0] for _, frame in seen] == [0, 1, 2]


def test_frame_that_comes_during_another_waits_even_if_it_is_more_important() -> None:
    low, high = Frame(0x700, b"\x55" * 8), Frame(0x001)
    assert [frame for _, frame in run([(0, 0, low), (1, 1, high)], 2)] == [low, high]


def test_frame_that_comes_within_the_intermission_takes_part() -> None:
    first, low, high = Frame(0x100), Frame(0x700), Frame(0x001)
    end = run([(0, 0, first)], 1)[0][0]
    for when in (end, end + 1_500, end + 3_000):
        seen = run([(0, 0, first), (10, 0, low), (when, 1, high)], 2)
        assert [frame for _, frame in seen] == [first, high, low], when
    late = run([(0, 0, first), (10, 0, low), (end + 3_001, 1, high)], 2)
    assert [frame for _, frame in late] == [first, low, high]


def test_port_keeps_its_own_order() -> None:
    sent = [Frame(can_id) for can_id in (0x300, 0x100, 0x200)]
    assert [frame for _, frame in run([(0, 0, frame) for frame in sent], 1)] == sent


def test_every_port_but_the_sender_gets_the_frame_at_its_end() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    seen: list[tuple[str, Frame, int]] = []

    def note(name: str) -> OnFrame:
        return lambda frame, at: seen.append((name, frame, at))

    ports = {name: segment.attach(name, Hearing(note(name))) for name in "abc"}
    ports["b"].on_sent = note("b sent")
    frame = Frame(0x080)
    ports["b"].send(frame)
    timeline.run_until(Instant(1_000_000))
    end = len(reference_wire_bits(frame)) * NS_PER_US
    assert seen == [("a", frame, end), ("c", frame, end), ("b sent", frame, end)]


def test_answers_sent_on_delivery_are_arbitrated_after_the_intermission() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    order: list[int] = []
    for node in (3, 1, 2):
        port = segment.attach(f"node{node}", Listener())

        def answer(
            frame: Frame, _at: Instant, node: int = node, send: Callable[[Frame], None] = port.send
        ) -> None:
            if frame.can_id == 0x80:
                send(Frame(0x180 + node))

        port.listener = Hearing(answer)
    segment.add_monitor(lambda frame, _at: order.append(frame.can_id))
    segment.attach("master", Listener()).send(Frame(0x80))
    timeline.run_until(Instant(1_000_000))
    assert order == [0x080, 0x181, 0x182, 0x183]


def test_full_queue_refuses_one_frame_more_and_loses_none() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    port = segment.attach("babbler", Listener())
    for _ in range(TRANSMIT_QUEUE_MAX):
        port.send(Frame(0x100))
    with pytest.raises(can.CanOperationError, match="babbler: transmit queue is full"):
        port.send(Frame(0x100))
    timeline.run_until(Instant(1_000_000_000))
    assert (segment.frames, port.pending) == (TRANSMIT_QUEUE_MAX, 0)


def test_detached_port_sends_what_it_has_and_hears_nothing() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    heard: list[Frame] = []
    sent: list[Frame] = []
    leaving = segment.attach("leaving", Hearing(lambda frame, _at: heard.append(frame)))
    staying = segment.attach("staying", Listener())
    leaving.on_sent = lambda frame, _at: sent.append(frame)
    for number in range(3):
        leaving.send(Frame(0x100 + number))
    staying.send(Frame(0x300))
    leaving.detach()
    timeline.run_until(Instant(10_000_000))
    assert segment.frames == 4
    assert heard == sent == []
    assert segment.ports == (staying,)
    with pytest.raises(can.CanOperationError, match="detached"):
        leaving.send(Frame(0x100))


def test_failing_callback_does_not_stop_the_bus() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    failures = [ZeroDivisionError()]

    def fail_once(_frame: Frame, _at: Instant) -> None:
        if failures:
            raise failures.pop()

    segment.add_monitor(fail_once)
    port = segment.attach("port", Listener())
    port.send(Frame(0x001))
    port.send(Frame(0x002))
    with pytest.raises(ZeroDivisionError):
        timeline.run_until(Instant(1_000_000))
    timeline.run_until(Instant(1_000_000))
    assert segment.frames == 2


@pytest.mark.parametrize("bitrate", [125_000, 500_000, 1_000_000])
def test_load_of_a_periodic_bus_is_its_closed_form(bitrate: int) -> None:
    """n frames of b bits and 3 bits of intermission each period: n (b + 3) / (bitrate * period)."""
    timeline = Timeline()
    segment = CanSegment(timeline, bitrate)
    port = segment.attach("port", Listener())
    frames = [Frame(0x080), Frame(0x181, b"\x12\x34\x56\x78\x9a\xbc\xde\xf0"), Frame(0x201, b"\x55")]
    period_ns, periods = 10_000_000, 200
    for cycle in range(periods):
        for frame in frames:
            timeline.post(Instant(cycle * period_ns), sender_of(port.send, frame))
    timeline.run_until(Instant(period_ns * periods))
    bits = sum(len(reference_wire_bits(frame)) + 3 for frame in frames)
    expected = 100.0 * bits * 1e9 / bitrate / period_ns
    assert segment.load_percent(Instant(0), timeline.now) == pytest.approx(expected, rel=1e-12)
    for first, last in ((10, 20), (50, 51), (0, 199)):
        window = (Instant(first * period_ns), Instant(last * period_ns))
        assert segment.load_percent(*window) == pytest.approx(expected, rel=1e-12)
    assert segment.busy_ns == pytest.approx(bits * 1e9 / bitrate * periods, rel=1e-12)


def test_saturated_bus_has_full_load_and_an_empty_interval_none() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    port = segment.attach("port", Listener())

    def refill(_frame: Frame, _at: Instant) -> None:
        port.send(Frame(0x100, b"\x33" * 8))

    port.on_sent = refill
    port.send(Frame(0x100))
    timeline.run_until(Instant(50_000_000))
    assert segment.load_percent(Instant(1_000_000), Instant(49_000_000)) == 100.0
    assert segment.load_percent(Instant(5), Instant(5)) == 0.0


def test_bit_rate_must_be_positive() -> None:
    with pytest.raises(ValueError, match="bitrate 0"):
        CanSegment(Timeline(), 0)
