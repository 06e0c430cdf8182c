"""Signals altered in PDOs: what a tap behind the fates sees, of mappings that only the frames have told."""

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.alterations import saturated
from servobench.virtual_bus.faults.fates import FateSource, RecordedFaults
from servobench.virtual_bus.faults.fault_log import FaultLog, entry_line, read_line
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.frame_fault import FrameFault
from servobench.virtual_bus.faults.kinds.delay import Delay
from servobench.virtual_bus.faults.kinds.duplicate import Duplicate
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.faults.kinds.signal import SignalFault
from servobench.virtual_bus.faults.node_faults import DrawnNode
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.faulty_device import FaultyDevice
from servobench.virtual_bus.hosting.injection import Faults, Injection
from tests.draws import examples_of
from tests.unit.virtual_bus.test_fault_plan_toml import load
from tests.unit.virtual_bus.test_node_faults import FaultyBench

OUT, IN = Direction.HOST_TO_DRIVE, Direction.DRIVE_TO_HOST
MS = NS_PER_MS
STATUS, MODE, VELOCITY, TORQUE, TARGET = 0x60410010, 0x60610008, 0x606C0020, 0x60770010, 0x60710010
CONTROL = 0x60400010


class Tap:
    """Two parties, and between them what ``faults`` make of each frame, with its delay."""

    def __init__(
        self, *faults: SignalFault | FrameFault, seed: int = 5, replay: RecordedFaults | None = None
    ) -> None:
        self.log = FaultLog()
        signals = tuple(fault for fault in faults if isinstance(fault, SignalFault))
        frames = tuple(fault for fault in faults if isinstance(fault, FrameFault))
        plan: Faults = FaultPlan(frames, signals=signals) if replay is None else replay
        made = Injection(plan, seed, self.log).fates
        assert made is not None
        self.fates: FateSource = made
        self.now = Instant(0)

    def pass_on(self, way: Direction, frame: Frame) -> list[tuple[Frame, Duration]]:
        return list(self.fates.goes_on(int(way), frame, self.now))

    def exchange(self, node: int, request: bytes, answer: bytes) -> None:
        """One SDO, which passes as it is."""
        for way, frame in ((OUT, Frame(0x600 + node, request)), (IN, Frame(0x580 + node, answer))):
            assert self.pass_on(way, frame) == [(frame, 0)]

    def write(
        self, node: int, index: int, sub: int, value: int, code: str = "I", aborted: bool = False
    ) -> None:
        raw = struct.pack("<" + code, value)
        head = struct.pack("<HB", index, sub)
        answer = b"\x80" + head + bytes(4) if aborted else b"\x60" + head + bytes(4)
        self.exchange(node, bytes([0x23 | 4 - len(raw) << 2]) + head + raw.ljust(4, b"\0"), answer)

    def read(self, node: int, index: int, sub: int, value: int, code: str = "I") -> None:
        raw = struct.pack("<" + code, value)
        head = struct.pack("<HB", index, sub)
        answer = bytes([0x43 | 4 - len(raw) << 2]) + head + raw.ljust(4, b"\0")
        self.exchange(node, b"\x40" + head + bytes(4), answer)

    def map(self, node: int, mapping: int, cob_id: int, *words: int) -> None:
        """As a master maps a PDO."""
        self.write(node, mapping - 0x200, 1, cob_id | 1 << 31)
        self.write(node, mapping, 0, 0, "B")
        for sub, word in enumerate(words, start=1):
            self.write(node, mapping, sub, word)
        self.write(node, mapping, 0, len(words), "B")
        self.write(node, mapping - 0x200, 1, cob_id)

    def start(self) -> None:
        self.fates.start(self.now)
        self.zero = self.now

    def pdo(self, way: Direction, can_id: int, code: str, *values: int, after_ms: float = 1.0) -> Any:
        """The values that come through, of a PDO that nothing loses or doubles."""
        self.now = Instant(self.now + round(after_ms * MS))
        ((frame, _),) = self.pass_on(way, Frame(can_id, struct.pack("<" + code, *values)))
        return struct.unpack("<" + code, frame.data)


def mapped(*faults: SignalFault | FrameFault, seed: int = 5) -> Tap:
    tap = Tap(*faults, seed=seed)
    tap.map(1, 0x1A00, 0x181, STATUS, VELOCITY)
    tap.map(1, 0x1600, 0x201, CONTROL, TARGET)
    tap.start()
    return tap


def velocity(how: str, **keys: Any) -> SignalFault:
    return SignalFault.model_validate({"object": "velocity_actual_value", "how": how, **keys})


def velocities(tap: Tap, values: Sequence[int]) -> list[int]:
    found = [tap.pdo(IN, 0x181, "Hi", 0x1237, value) for value in values]
    assert {status for status, _ in found} == {0x1237}, "its neighbour stays"
    return [value for _, value in found]


@pytest.mark.parametrize(
    ("signal", "expected"),
    [
        (velocity("stuck"), [10, 10, 10, 10]),
        (velocity("stuck", stuck_raw=-7), [-7, -7, -7, -7]),
        (velocity("offset", offset_raw=-4), [6, -24, 26, -44]),
        (velocity("drift", drift_raw_per_s=1000), [11, -18, 33, -36]),
        (velocity("noise", noise_raw_rms=0), [10, -20, 30, -40]),
        (velocity("scale", factor=1.5), [15, -30, 45, -60]),
        (velocity("sign"), [-10, 20, -30, 40]),
        (velocity("bits", set_bits=1, cleared_bits=2), [9, -19, 29, -39]),
        (velocity("offset", offset_raw=1, from_s=0.002, until_s=0.004), [10, -19, 31, -40]),
        (velocity("stuck", from_s=0.002), [10, -20, -20, -20]),
        (velocity("offset", offset_raw=1, nodes=[2]), [10, -20, 30, -40]),
        (velocity("offset", offset_raw=1, direction="host_to_drive"), [10, -20, 30, -40]),
    ],
    ids=lambda value: value.how if isinstance(value, SignalFault) else "",
)
def test_what_becomes_of_a_velocity(signal: SignalFault, expected: list[int]) -> None:
    assert velocities(mapped(signal), [10, -20, 30, -40]) == expected


def test_a_value_ends_at_the_range_of_its_type() -> None:
    tap = mapped(
        velocity("scale", factor=1000),
        SignalFault(object="6071", how="sign"),
        SignalFault(object="statusword", how="offset", offset_raw=-1e6),
    )
    assert tap.pdo(IN, 0x181, "Hi", 0xFFFF, 2_147_484) == (0, 2**31 - 1)
    assert tap.pdo(IN, 0x181, "Hi", 0xFFFF, -2_147_484) == (0, -(2**31))
    assert tap.pdo(OUT, 0x201, "Hh", 15, -0x8000) == (15, 0x7FFF)


@examples_of(100)
@given(value=st.floats(-1e12, 1e12), bits=st.integers(1, 32), signed=st.booleans())
def test_saturation_is_numpys_rounding_and_clip(value: float, bits: int, signed: bool) -> None:
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    assert saturated(value, bits, signed) == int(np.clip(np.rint(value), low, high))


def test_bits_of_a_statusword_are_cleared() -> None:
    tap = mapped(SignalFault(object="statusword", how="bits", cleared_bits=1 << 12))
    assert tap.pdo(IN, 0x181, "Hi", 0x1637, 5) == (0x0637, 5)


def test_noise_is_normal_and_white() -> None:
    tap = mapped(velocity("noise", noise_raw_rms=1000))
    found = np.array(velocities(tap, [500_000] * 4000)) - 500_000
    assert stats.kstest(found / 1000, "norm").pvalue > 0.01
    assert abs(np.corrcoef(found[1:], found[:-1])[0, 1]) < 0.05


def test_frames_are_struck_with_the_probability_that_is_asked_for() -> None:
    tap = mapped(velocity("offset", offset_raw=1, probability=0.1))
    struck = sum(velocities(tap, [0] * 4000))
    low, high = stats.binomtest(struck, 4000, 0.1).proportion_ci(0.99)
    assert low < 0.1 < high
    assert tap.fates.counts()["drive_to_host"]["signal_offset"] == struck


def test_a_signal_is_altered_on_its_way_to_the_drive_too() -> None:
    tap = mapped(SignalFault(object="target_torque", how="scale", factor=0.5))
    assert tap.pdo(OUT, 0x201, "Hh", 15, 300) == (15, 150)
    assert tap.pdo(IN, 0x201, "Hh", 15, 300) == (15, 300), "nobody's PDO"


def test_signals_of_one_object_act_one_after_the_other() -> None:
    both = velocity("offset", offset_raw=1), velocity("scale", factor=10)
    assert velocities(mapped(*both), [1, 2]) == [20, 30]
    assert velocities(mapped(*both[::-1]), [1, 2]) == [11, 21]


def test_mappings_that_a_master_only_reads_are_known() -> None:
    tap = Tap(velocity("offset", offset_raw=5))
    tap.read(1, 0x1A01, 0, 2, "B")
    tap.read(1, 0x1A01, 1, TORQUE)
    tap.read(1, 0x1A01, 2, VELOCITY)
    tap.start()
    assert tap.pdo(IN, 0x281, "hi", 7, 100) == (7, 105), "by the pre-defined COB-ID of TPDO2"


def test_the_identifier_is_that_of_the_cob_id() -> None:
    tap = Tap(velocity("offset", offset_raw=5))
    tap.map(9, 0x1A00, 0x1F3, VELOCITY)
    tap.start()
    assert tap.pdo(IN, 0x1F3, "i", 1) == (6,)
    assert tap.pdo(IN, 0x189, "i", 1) == (1,)


def test_what_a_drive_refuses_is_not_mapped() -> None:
    tap = mapped(velocity("offset", offset_raw=5))
    tap.write(1, 0x1A00, 1, VELOCITY, aborted=True)
    tap.write(1, 0x1A00, 2, STATUS, aborted=True)
    assert tap.pdo(IN, 0x181, "Hi", 3, 1) == (3, 6)


def test_a_pdo_mapped_anew_carries_it_elsewhere_and_a_boot_forgets_all() -> None:
    tap = mapped(velocity("offset", offset_raw=5))
    tap.map(1, 0x1A00, 0x181, VELOCITY, STATUS)
    assert tap.pdo(IN, 0x181, "iH", 1, 3) == (6, 3)
    tap.pass_on(IN, Frame(0x701, b"\x00"))
    assert tap.pdo(IN, 0x181, "iH", 1, 3) == (1, 3)
    tap.pass_on(IN, Frame(0x701, b"\x05"))
    tap.map(1, 0x1A00, 0x181, STATUS, VELOCITY)
    assert tap.pdo(IN, 0x181, "Hi", 3, 1) == (3, 6)


def test_fields_off_the_byte_borders_and_frames_that_are_too_short() -> None:
    tap = Tap(SignalFault(object="2001:3", how="offset", offset_raw=1, signed=False))
    tap.map(1, 0x1A00, 0x181, 0x20010103, 0x2001030B, 0x00050002)
    tap.start()
    value = 0b01_10000000111_101
    assert tap.pdo(IN, 0x181, "H", value) == (0b01_10000001000_101,)
    assert tap.pdo(IN, 0x181, "B", 0xFF) == (0xFF,)


def test_frames_before_time_zero_and_after_the_end_pass() -> None:
    tap = Tap(velocity("sign"))
    tap.map(1, 0x1A00, 0x181, STATUS, VELOCITY)
    assert tap.pdo(IN, 0x181, "Hi", 3, 1) == (3, 1)
    tap.start()
    assert tap.pdo(IN, 0x181, "Hi", 3, 1) == (3, -1)
    tap.fates.stop()
    assert tap.pdo(IN, 0x181, "Hi", 3, 1) == (3, 1)


def test_a_signal_that_no_pdo_carries_is_said_once() -> None:
    tap = mapped(
        SignalFault(object="torque_actual_value", how="sign", from_s=0.003),
        velocity("sign", nodes=[1, 4]),
        velocity("stuck"),
    )
    velocities(tap, [1] * 6)
    said = [line for each in tap.log.entries() if "nowhere" in (line := entry_line(each))]
    assert said == [
        '{"kind":"signal_nowhere","at_ns":1000000,"direction":"drive_to_host","can_id":385,"n":0,"object":6319104,'
        '"node":4}',
        '{"kind":"signal_nowhere","at_ns":3000000,"direction":"drive_to_host","can_id":385,"n":2,"object":6321920,'
        '"node":0}',
    ]


def test_an_altered_frame_meets_the_other_faults() -> None:
    signal = velocity("sign")
    twice = mapped(signal, Duplicate(probability=1.0, later_us=40), Delay(delay_us=100))
    twice.now = Instant(MS)
    altered = Frame(0x181, struct.pack("<Hi", 1, -5))
    assert twice.pass_on(IN, Frame(0x181, struct.pack("<Hi", 1, 5))) == [
        (altered, 100_000),
        (altered, 140_000),
    ]
    assert mapped(signal, Loss(probability=1.0)).pass_on(IN, altered) == []


def test_no_draw_depends_on_another_fault() -> None:
    noise = velocity("noise", noise_raw_rms=50, probability=0.5)
    alone = velocities(mapped(noise), [0] * 300)
    others = SignalFault(object="statusword", how="noise", noise_raw_rms=0), Delay(delay_us=3)
    assert velocities(mapped(others[0], noise, others[1]), [0] * 300) == alone
    windowed = velocity("noise", noise_raw_rms=50, probability=0.5, from_s=0.1)
    assert velocities(mapped(windowed), [0] * 300)[100:] == alone[100:]
    assert velocities(mapped(noise, seed=6), [0] * 300) != alone


def test_a_replay_alters_the_same_frames_to_the_same_bytes() -> None:
    faults: list[SignalFault | FrameFault] = [
        velocity("noise", noise_raw_rms=50, probability=0.5),
        velocity("scale", factor=3),
        SignalFault(object="target_torque", how="drift", drift_raw_per_s=1e4),
        SignalFault(object="6079", how="sign", signed=True),
        Delay(delay_min_us=0, delay_max_us=300),
        Loss(probability=0.1),
        Duplicate(probability=0.1),
    ]

    def traffic(tap: Tap) -> list[Any]:
        found = []
        for k in range(300):
            tap.now = Instant(tap.now + MS)
            found.append(tap.pass_on(OUT, Frame(0x201, struct.pack("<Hh", 15, k))))
            found.append(tap.pass_on(IN, Frame(0x181, struct.pack("<Hi", 0x1237, -k))))
        return found

    first = mapped(*faults)
    went = traffic(first)
    lines = [entry_line(entry) for entry in first.log.entries()]
    recorded = RecordedFaults(
        tuple(read_line(line, "faults.jsonl", n) for n, line in enumerate(lines, start=1))
    )
    again = Tap(replay=recorded)
    again.now = first.zero
    again.start()
    assert traffic(again) == went
    assert [entry_line(entry) for entry in again.log.entries()] == lines


def test_at_the_drives_connection_the_drive_itself_hears_another_torque() -> None:
    """The witness is the shaft: half the torque, half the speed."""
    speeds = []
    for factor in (1.0, 0.5):
        bench = FaultyBench()
        signal = SignalFault(object="target_torque", how="scale", factor=factor, side="drive")
        fates = Injection(
            FaultPlan(signals=(signal.model_copy(update={"side": None}),)), 1, side="drive"
        ).fates
        bench.device = FaultyDevice(bench.servo, DrawnNode(FaultPlan(), 1, 3), None, fates)

        def hear(frame: Frame, bench: FaultyBench = bench) -> Any:
            return bench.device.receive(frame, bench.now)

        for sub, word in ((0, 0), (1, CONTROL), (2, TARGET), (0, 2)):
            if (sub, word) == (0, 0):
                hear(Frame(0x601, struct.pack("<BHBI", 0x23, 0x1400, 1, 0x80000201)))
            size = "<BHBB3x" if sub == 0 else "<BHBI"
            hear(Frame(0x601, struct.pack(size, 0x2F if sub == 0 else 0x23, 0x1600, sub, word)))
        hear(Frame(0x601, struct.pack("<BHBI", 0x23, 0x1400, 1, 0x201)))
        bench.begin()
        for controlword in (0x06, 0x07, 0x0F):
            hear(Frame(0x201, struct.pack("<Hh", controlword, 200)))
            bench.pass_ms(0.2)
        bench.pass_ms(40)
        speeds.append(bench.speed_rad_s)
    assert speeds[0] > 1.0
    assert speeds[1] == pytest.approx(0.5 * speeds[0], rel=0.02)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('object = "velocity"\nhow = "stuck"', '"velocity_actual_value", the nearest name'),
        ('object = "velocity_actual_valu"\nhow = "stuck"', '"velocity_actual_value", the nearest name'),
        ('object = 0x606C\nhow = "stuck"', 'an object, such as "606C"'),
        (
            'object = "606C"\nhow = "offset"',
            'offset_raw: missing, expected a number, for how = "offset"',
        ),
        ('object = "606C"\nhow = "bits"', "set_bits or cleared_bits"),
        (
            'object = "606C"\nhow = "sign"\nfactor = 2',
            'expected nothing unless how = "scale"',
        ),
        ('object = "statusword"\nhow = "sign"', "another way: statusword has no sign"),
        ('object = "606C"\nhow = "wrong"', "one of stuck, offset, drift, noise, scale, sign, bits"),
        ('object = "606C"\nhow = "offset"\noffset_rpm = 3', "signal.0..offset_r"),
    ],
)
def test_what_cannot_be_is_named(table: str, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        load(f"[[signal]]\n{table}")
