"""Random frames, malformed ones included: no exception, no hang, every valid request answered."""

import random

from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.frame import Frame
from tests.draws import examples_of
from tests.unit.virtual_bus.device_bench import DEFAULTS, NODE, Bench

CAN_IDS = (0x000, 0x080, 0x180 + NODE, 0x200 + NODE, 0x300 + NODE, 0x600 + NODE, 0x700 + NODE, 0x77F)
INDICES: tuple[int, ...] = (
    0x1003,
    0x1005,
    0x1014,
    0x1016,
    0x1017,
    0x1019,
    0x1029,
    0x1400,
    0x1600,
    0x1800,
    0x1801,
    0x1A00,
)
INDICES += (0x1A01, 0x2000, 0x2001, 0x6000, 0x6100, 0x6102, 0x7777)
FRAMES_MAX = 200

frames = st.builds(
    Frame,
    st.sampled_from(CAN_IDS) | st.integers(0, 0x7FF),
    st.binary(max_size=8),
    extended=st.sampled_from((False, False, False, True)),
    remote=st.sampled_from((False, False, False, True)),
)


def sdo(lottery: random.Random) -> bytes:
    """An SDO request that is well-formed in its first four bytes."""
    command = lottery.choice((0x40, 0x23, 0x2B, 0x2F, 0x21, 0x20, 0xA4, 0xC6, 0xC4, lottery.randrange(256)))
    index, subindex = lottery.choice(INDICES), lottery.choice((0, 1, 2, 5, 9))
    value = lottery.choice((0, 1, 5, 254, 0x61000010, 0x80000285, lottery.getrandbits(32)))
    return bytes([command]) + index.to_bytes(2, "little") + bytes([subindex]) + value.to_bytes(4, "little")


def answers_a_plain_read(bench: Bench) -> bool:
    """After NMT pre-operational and an abort of what may be running, 1000h can be read."""
    bench.nmt(128)
    bench.put(0x600 + NODE, b"\x80" + bytes(7))
    answers = bench.put(0x600 + NODE, b"\x40\x00\x10\x00\x00\x00\x00\x00")
    return [answer.data[:4] for answer in answers] == [b"\x43\x00\x10\x00"]


@given(st.lists(st.tuples(frames, st.integers(0, 50_000_000)), max_size=60))
@examples_of(150)
def test_random_frames(sequence: list[tuple[Frame, int]]) -> None:
    bench = Bench()
    for frame, pause_ns in sequence:
        bench.run_until_ms((bench.now + pause_ns) / 1e6)
        answers = bench.device.receive(frame, bench.now)
        assert len(answers) <= FRAMES_MAX
        assert all(len(answer.data) <= 8 and answer.can_id <= 0x7FF for answer in answers)
    assert answers_a_plain_read(bench)


def test_a_long_walk_of_plausible_frames() -> None:
    """10^5 frames, most of them requests that could be meant, on one device that is never restarted."""
    lottery = random.Random(301)
    bench = Bench(DEFAULTS)
    unanswered = 0
    for step in range(100_000):
        bench.now = Instant(bench.now + lottery.randrange(1_000_000))
        due = bench.device.wake_at
        if due is not None and due <= bench.now:
            assert len(bench.device.wake(bench.now)) <= FRAMES_MAX
        can_id = lottery.choice((*CAN_IDS, 0x600 + NODE, 0x600 + NODE))
        data = sdo(lottery) if can_id == 0x600 + NODE else lottery.randbytes(lottery.randrange(9))
        if can_id == 0:
            data = bytes([lottery.choice((1, 1, 1, 2, 128, 129, 130)), NODE])
        bench.device.receive(Frame(can_id, data, remote=lottery.random() < 0.05), bench.now)
        if step % 100 == 0:
            unanswered += not answers_a_plain_read(bench)
            bench.nmt(1)
            assert bench.device.state is NmtState.OPERATIONAL
    assert unanswered == 0
