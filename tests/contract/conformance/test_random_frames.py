"""Random frames, malformed ones included, on the whole simulated servo: nothing breaks, nothing hangs.

Valid requests are strewn in, each of which must be answered: the NMT state by node guarding, boot-up
after a reset, an SDO upload wherever SDOs are served.
"""

import random
from collections.abc import Sequence

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from servobench.drivers.canopen.nmt_states import NODE_ID_MAX, NmtState
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Instant
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from tests.contract.conformance.rig import GUARD, NODE, SDO_REQUEST, initiate
from tests.motors import LING

EXAMPLES, FRAMES = 250, 400
"""10^5 frames in all."""
FRAME_GAP_NS = 130 * NS_PER_US
BOOT_NS = 100 * NS_PER_MS
WAKES_MAX = 50
FRAMES_OUT_MAX = 300
SERVED = (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)

PDO_IDS = tuple(base + NODE for base in (0x180, 0x200, 0x280, 0x300, 0x400, 0x500))
KNOWN_IDS = (0x000, 0x080, 0x100, 0x7E5, *[SDO_REQUEST] * 3, GUARD, 0x70A, *PDO_IDS)
INDICES = (
    *range(0x1000, 0x101A),
    *(0x1029, 0x1200, 0x1400, 0x1600, 0x1800, 0x1802, 0x1A00, 0x1A02),
    *(0x6040, 0x6041, 0x6060, 0x6064, 0x6071, 0x6072, 0x607A, 0x6085, 0x60FF, 0x2100, 0x5F00),
)
COMMANDS = (
    *(0x00, 0x01, 0x10, 0x21, 0x22, 0x23, 0x2B, 0x2F, 0x40, 0x60, 0x70, 0x80),
    *(0xA0, 0xA1, 0xA2, 0xA3, 0xA4, 0xC0, 0xC2, 0xC4, 0xC6, 0xC1, 0xD5, 0xE0),
)
LSS = (0x04, 0x11, 0x13, 0x15, 0x17, *range(0x40, 0x44), *range(0x46, 0x4D), 0x51, *range(0x5A, 0x5F))
NMT = (1, 2, 128, 129, 130, 1, 1, 1)

Draw = tuple[int, int, bytes, int]
"""Kind of frame, a choice, 8 bytes, a length."""


def frame_of(draw: Draw) -> Frame:
    kind, choice, data, length = draw
    if kind < 3:
        index = INDICES[choice % len(INDICES)].to_bytes(2, "little")
        command = bytes([COMMANDS[choice // 7 % len(COMMANDS)]])
        return Frame(SDO_REQUEST, command + index + bytes([data[0] % 9]) + data[4:8])
    if kind == 3:
        return Frame(SDO_REQUEST, bytes([COMMANDS[choice % len(COMMANDS)]]) + data[1:])
    if kind == 4:
        return Frame(0x000, bytes([NMT[choice % len(NMT)], NODE * (choice % 2)]))
    if kind == 5:
        return Frame(0x7E5, bytes([LSS[choice % len(LSS)]]) + data[1:])
    if kind == 6:
        return Frame(KNOWN_IDS[choice % len(KNOWN_IDS)], data[:length])
    if kind == 7:
        return Frame(KNOWN_IDS[choice % len(KNOWN_IDS)], b"", remote=True, remote_length=length)
    if kind == 8:
        return Frame(choice << 18 | choice, data[:length], extended=True)
    return Frame(choice % 0x800, data[:length])


class Ordeal:
    """The servo and its time."""

    def __init__(self) -> None:
        self.device = SimulatedServo(NODE, LING)
        self.now = Instant(0)
        self.device.start(self.now)

    def put(self, frame: Frame) -> Sequence[Frame]:
        self.now = Instant(self.now + FRAME_GAP_NS)
        for _ in range(WAKES_MAX):
            due = self.device.wake_at
            if due is None or due > self.now:
                break
            self.device.wake(self.now)
        else:
            raise AssertionError("the device asks for time without end")
        frames = self.device.receive(frame, self.now)
        assert len(frames) <= FRAMES_OUT_MAX
        for sent in frames:
            assert len(sent.data) <= 8
            assert 0 <= sent.can_id < 0x800
        return frames

    def check_alive(self) -> None:
        """Requests that a device must answer in the state it is in."""
        device = self.device
        assert device.state in NmtState
        if device.state not in SERVED:
            return
        node_id = device.node_id
        self.put(Frame(0x600 + node_id, initiate(0x80, 0, 0)))
        answers = self.put(Frame(0x600 + node_id, initiate(0x40, 0x1000, 0)))
        expected = initiate(0x43, 0x1000, 0, (0x20192).to_bytes(4, "little"))
        assert Frame(0x580 + node_id, expected) in answers

    def check_reset(self) -> None:
        """Whatever happened, a reset leads to boot-up."""
        node_id = self.device.node_id
        if node_id <= NODE_ID_MAX:
            self.put(Frame(0x000, bytes([129, 0])))
            ends_at = self.now + BOOT_NS
            boot_up: list[Frame] = []
            while not boot_up and (due := self.device.wake_at) is not None and due <= ends_at:
                boot_up += [frame for frame in self.device.wake(due) if frame.can_id >= 0x700]
            assert boot_up == [Frame(0x700 + self.device.node_id, b"\x00")]
            assert self.device.state is NmtState.PRE_OPERATIONAL


DRAWS = st.lists(
    st.tuples(
        st.integers(0, 9),
        st.integers(0, 0x7FF),
        st.integers(0, (1 << 64) - 1).map(lambda number: number.to_bytes(8, "little")),
        st.integers(0, 8),
    ),
    min_size=4,
    max_size=4,
)


@settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(DRAWS, st.integers(0, (1 << 32) - 1))
def test_nothing_breaks_the_servo(first: list[Draw], seed: int) -> None:
    stream = random.Random(seed)
    ordeal = Ordeal()
    for draw in first:
        ordeal.put(frame_of(draw))
    for number in range(FRAMES):
        draw = (stream.randrange(10), stream.randrange(0x800), stream.randbytes(8), stream.randrange(9))
        frames = ordeal.put(frame_of(draw))
        if draw[0] < 3 and ordeal.device.state in SERVED and not frames:
            ordeal.check_alive()
        if number % 20 == 0:
            ordeal.check_alive()
    ordeal.check_reset()
