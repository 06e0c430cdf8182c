"""Kernel and adapter stamps on the monotonic clock, with the wall clock set in between; all made up."""

import random
import socket
from collections.abc import Iterator
from struct import pack

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Instant, MonotonicClock, wall_between
from servobench.drivers.wire.frame_port import ERROR_FLAG, EchoBasis, WireFrame
from servobench.drivers.wire.socketcan import SocketcanPort
from servobench.drivers.wire.socketcan_stamps import (
    ANCILLARY_BYTES,
    REORDERED_MAX_NS,
    SO_RXQ_OVFL,
    SO_TIMESTAMPING,
    SO_TIMESTAMPNS,
    AdapterClock,
    FrameStamps,
    WallStamps,
    parse_ancillary,
)
from tests.draws import examples_of

EXAMPLES = examples_of(200)
EPOCH = 1_700_000_000 * NS_PER_S
"""Wall clock minus monotonic clock at the start."""
TURN_NS = 10 * NS_PER_MS
"""Between two drains of the queue."""
READING_NS = 300
"""Between two readings of a clock."""
SEEN_FOR_SURE_NS = TURN_NS + REORDERED_MAX_NS + 10 * NS_PER_US
"""A step that is larger can be told from none for every frame."""

steps = st.integers(SEEN_FOR_SURE_NS, 3600 * NS_PER_S) | st.integers(-3600 * NS_PER_S, -SEEN_FOR_SURE_NS)
small_steps = st.integers(-SEEN_FOR_SURE_NS, SEEN_FOR_SURE_NS)
turns = st.lists(
    st.tuples(
        st.lists(st.integers(0, TURN_NS - 1), max_size=6),
        st.none() | st.tuples(st.integers(0, TURN_NS - 1), steps),
    ),
    max_size=12,
)


class Kernel:
    """A queue of stamped frames, and a wall clock that is set."""

    def __init__(self) -> None:
        self.now = NS_PER_S
        self.offset = EPOCH
        self.stamps = WallStamps()
        self.compare()
        self.stamps.emptied(self.now)

    def compare(self) -> Instant:
        before, self.now = self.now, self.now + READING_NS
        self.stamps.compare(before, before + READING_NS // 2 + self.offset, self.now)
        return Instant(self.now)

    def turn(self, frames: list[int], step: tuple[int, int] | None) -> list[tuple[int, int]]:
        """Frames and a step at instants after the last drain, and the next drain: (truth, mapped)."""
        start = self.now
        set_at, step_ns = (start + step[0], step[1]) if step is not None else (start, 0)
        truths = sorted(start + frame for frame in frames)
        queue = [truth + self.offset + (step_ns if truth >= set_at else 0) for truth in truths]
        self.offset += step_ns
        self.now = start + TURN_NS
        mapped = [self.stamps.instant(stamp, self.compare()) for stamp in queue]
        empty_at = self.now
        self.compare()
        self.stamps.emptied(empty_at)
        return list(zip(truths, mapped, strict=True))


@EXAMPLES
@given(turns)
def test_no_step_moves_a_stamp(traffic: list[tuple[list[int], tuple[int, int] | None]]) -> None:
    kernel = Kernel()
    for frames, step in traffic:
        for truth, mapped in kernel.turn(frames, step):
            assert abs(mapped - truth) <= READING_NS


@EXAMPLES
@given(st.lists(st.tuples(st.lists(st.integers(0, TURN_NS - 1), max_size=6), small_steps), max_size=12))
def test_a_step_that_cannot_be_seen_moves_a_stamp_by_no_more_than_itself(
    traffic: list[tuple[list[int], int]],
) -> None:
    """The one before it may still be in doubt for the first frame of a turn."""
    kernel, step_before_ns = Kernel(), 0
    for frames, step_ns in traffic:
        for truth, mapped in kernel.turn(frames, (TURN_NS // 2, step_ns)):
            assert abs(mapped - truth) <= max(abs(step_ns), abs(step_before_ns)) + READING_NS
            assert mapped <= kernel.now
        step_before_ns = step_ns


@EXAMPLES
@given(
    st.lists(st.tuples(st.integers(0, TURN_NS), st.integers(-NS_PER_S, NS_PER_S)), min_size=1, max_size=30)
)
def test_whatever_is_told_no_stamp_is_in_the_future_or_far_before_the_one_in_front(
    told: list[tuple[int, int]],
) -> None:
    stamps, now, last = WallStamps(), NS_PER_S, 0
    for passed, stamp_error in told:
        now += passed
        stamps.compare(now, now + EPOCH, now)
        mapped = stamps.instant(now + EPOCH + stamp_error, Instant(now))
        assert last - REORDERED_MAX_NS <= mapped <= now
        last = mapped


def test_a_step_back_moves_no_frame_of_a_queue_that_waits() -> None:
    """What was seen: eighty-two stamps shifted by the whole step."""
    kernel = Kernel()
    pairs = kernel.turn([number * 100_000 for number in range(100)], (5_000_000, -NS_PER_S))
    assert max(abs(mapped - truth) for truth, mapped in pairs) <= READING_NS


def test_an_offset_ends_when_the_next_is_seen_even_if_the_queue_is_never_empty() -> None:
    """Frames 5 ms after a step of 2 ms and 14 ms before they are read."""
    stamps = WallStamps()
    for at_ms, step_ms in ((1_000, 0), (1_011, 2)):
        stamps.compare(at_ms * NS_PER_MS, EPOCH + (at_ms + step_ms) * NS_PER_MS, at_ms * NS_PER_MS)
    now = Instant(1_030 * NS_PER_MS)
    stamps.compare(now, EPOCH + 1_032 * NS_PER_MS, now)
    assert stamps.instant(EPOCH + (1_016 + 2) * NS_PER_MS, now) == 1_016 * NS_PER_MS


def test_frames_that_were_stamped_a_little_out_of_order_keep_their_stamps() -> None:
    stamps = WallStamps()
    stamps.compare(NS_PER_S, NS_PER_S + EPOCH, NS_PER_S)
    for at in (NS_PER_S - 100_000, NS_PER_S - 400_000):
        assert stamps.instant(at + EPOCH, Instant(NS_PER_S)) == at


@pytest.mark.parametrize("rate_ppm", [-100.0, 0.0, 37.0, 100.0])
def test_the_adapters_clock_is_learnt_to_the_quickest_way_to_the_kernel(rate_ppm: float) -> None:
    """1 kHz, a way of 30 us and more by an exponential law of 60 us, and one frame in fifty 3 ms late."""
    source, clock, epoch = random.Random(5), AdapterClock(), 123_456_789_012
    errors = []
    for number in range(8_000):
        truth = NS_PER_S + number * NS_PER_MS
        late = 3 * NS_PER_MS if source.random() < 0.02 else round(source.expovariate(1 / 60_000))
        software = Instant(truth + 30 * NS_PER_US + late)
        mapped = clock.instant(epoch + round(truth * (1 + rate_ppm * 1e-6)), software)
        assert mapped <= software
        errors.append(mapped - truth - 30 * NS_PER_US)
    assert max(map(abs, errors[4_000:])) < 5 * NS_PER_US
    assert max(map(abs, errors[300:])) < 60 * NS_PER_US


def test_an_adapter_that_starts_anew_is_learnt_anew() -> None:
    clock = AdapterClock()
    for number in range(2_000):
        at = number * NS_PER_MS
        clock.instant(at, Instant(at + 50_000))
    for number in range(2_000, 2_100):
        at = number * NS_PER_MS
        assert clock.instant((number - 2_000) * NS_PER_MS, Instant(at + 50_000)) == at + 50_000


def test_a_clock_that_jumps_ahead_is_learnt_anew() -> None:
    clock = AdapterClock()
    clock.instant(0, Instant(50_000))
    assert clock.instant(NS_PER_S, Instant(NS_PER_MS)) == NS_PER_MS


def software(ns: int) -> tuple[int, int, bytes]:
    return socket.SOL_SOCKET, SO_TIMESTAMPNS, pack("@qq", *divmod(ns, NS_PER_S))


def hardware(ns: int) -> tuple[int, int, bytes]:
    return socket.SOL_SOCKET, SO_TIMESTAMPING, pack("@qqqqqq", 0, 0, 0, 0, *divmod(ns, NS_PER_S))


def overflow(count: int) -> tuple[int, int, bytes]:
    return socket.SOL_SOCKET, SO_RXQ_OVFL, pack("=I", count)


def test_ancillary_data_is_read_as_the_kernel_writes_it() -> None:
    assert parse_ancillary([software(EPOCH + 5), overflow(7)]) == FrameStamps(EPOCH + 5, None, 7)
    assert parse_ancillary([hardware(42), software(EPOCH)]) == FrameStamps(EPOCH, 42, None)
    assert parse_ancillary([]) == FrameStamps(None, None, None)


def test_an_adapter_without_stamps_leaves_zeroes() -> None:
    assert parse_ancillary([software(EPOCH), hardware(0)]).hardware_ns is None


def test_data_that_was_cut_off_is_none() -> None:
    cut = [(layer, kind, value[:-1]) for layer, kind, value in (software(1), hardware(1), overflow(1))]
    assert parse_ancillary(cut) == FrameStamps(None, None, None)


def test_there_is_room_for_all_of_it() -> None:
    whole = [software(1), hardware(1), overflow(1)]
    assert sum(socket.CMSG_SPACE(len(value)) for _, _, value in whole) == ANCILLARY_BYTES


class Socket(socket.socket):
    """A socket with packets that the kernel is said to have brought."""

    def __init__(self) -> None:
        ready, self._other = socket.socketpair()
        super().__init__(fileno=ready.detach())
        self.brought: list[tuple[bytes, list[tuple[int, int, bytes]], int]] = []

    def bring(self, word: int, data: bytes, ancillary: list[tuple[int, int, bytes]], flags: int = 0) -> None:
        self.brought.append((pack("=IB3x8s", word, len(data), data), ancillary, flags))
        self._other.send(b".")

    def recvmsg(self, *_sizes: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, None]:
        self.recv(1)
        return *self.brought.pop(0), None

    def close(self) -> None:
        self._other.close()
        super().close()


@pytest.fixture
def fake() -> Iterator[Socket]:
    fake = Socket()
    yield fake
    fake.close()


def test_own_frames_are_told_by_the_confirmation_and_not_by_the_route(fake: Socket) -> None:
    port = SocketcanPort(fake, MonotonicClock(), receive_own=True, channel="can0")
    msg_confirm, msg_dontroute = 0x800, 0x4
    for flags in (msg_confirm | msg_dontroute, msg_dontroute):
        fake.bring(0x181, b"\x01", [], flags)
    assert port.receive(Instant(0)) == WireFrame(0x181, b"\x01")
    assert port.came_own
    port.receive(Instant(0))
    assert not port.came_own
    assert port.echoes is EchoBasis.KERNEL


def test_hardware_stamps_are_taken_where_they_come_and_kernel_stamps_where_not(fake: Socket) -> None:
    port = SocketcanPort(fake, MonotonicClock(), receive_own=True, channel="can0")
    before, wall, _ = wall_between()
    sent_at = before - 10 * NS_PER_MS
    for number, late_us in enumerate((80, 20, 50)):
        stamp = wall - 10 * NS_PER_MS + number * NS_PER_MS + late_us * NS_PER_US
        fake.bring(0x080, b"", [software(stamp), hardware(77 + number * NS_PER_MS)], 0x800)
    stamps = []
    for _ in range(3):
        port.receive(Instant(0))
        stamps.append(port.came_at - sent_at)
    assert stamps[2] == pytest.approx(2 * NS_PER_MS + 20 * NS_PER_US, abs=70 * NS_PER_US)
    assert stamps[2] < 2 * NS_PER_MS + 45 * NS_PER_US
    assert port.echoes is EchoBasis.HARDWARE
    fake.bring(0x181, b"", [software(wall)])
    port.receive(Instant(0))
    assert port.came_at == pytest.approx(before, abs=NS_PER_MS)


def test_the_first_frame_does_not_hang_on_one_comparison_that_was_interrupted(
    fake: Socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparisons = 0

    def interrupted_once() -> tuple[Instant, int, Instant]:
        nonlocal comparisons
        comparisons += 1
        before = NS_PER_S + comparisons * NS_PER_MS
        wall_read_at = before + READING_NS
        after = wall_read_at + (NS_PER_MS // 2 if comparisons == 1 else READING_NS)
        return Instant(before), EPOCH + wall_read_at, Instant(after)

    monkeypatch.setattr("servobench.drivers.wire.socketcan.wall_between", interrupted_once)
    port = SocketcanPort(fake, MonotonicClock(), receive_own=False, channel="can0")
    at = NS_PER_S + NS_PER_MS
    fake.bring(0x181, b"", [software(EPOCH + at)])
    port.receive(Instant(0))
    assert abs(port.came_at - at) <= READING_NS


def test_error_frames_and_losses_are_handed_on(fake: Socket) -> None:
    port = SocketcanPort(fake, MonotonicClock(), receive_own=False, channel="can0")
    fake.bring(ERROR_FLAG | 0x40, bytes(8), [overflow(3)])
    assert port.receive(Instant(0)) == WireFrame(ERROR_FLAG | 0x40, bytes(8))
    assert port.lost_frames == 3
    assert port.receive(Instant(0)) is None
