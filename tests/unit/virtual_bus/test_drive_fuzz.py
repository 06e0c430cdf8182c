"""Whatever a master writes, in whatever mode: the drive goes on, within its limits, and stops when told."""

import math
from struct import pack

from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import State
from servobench.virtual_bus.drive.machine import MACHINE
from servobench.virtual_bus.frame import Frame
from tests.draws import examples_of
from tests.unit.virtual_bus.motion_bench import ENABLED, MotionBench
from tests.unit.virtual_bus.servo_bench import SYNC

SPEED_MAX_RPM = 2000
WRITES: tuple[tuple[int, int, str], ...] = (
    (Object.MODES_OF_OPERATION, 0, "b"),
    (Object.TARGET_POSITION, 0, "i"),
    (Object.TARGET_VELOCITY, 0, "i"),
    (Object.TARGET_TORQUE, 0, "h"),
    (Object.POSITION_OFFSET, 0, "i"),
    (Object.VELOCITY_OFFSET, 0, "i"),
    (Object.TORQUE_OFFSET, 0, "h"),
    (Object.PROFILE_VELOCITY, 0, "I"),
    (Object.PROFILE_ACCELERATION, 0, "I"),
    (Object.PROFILE_DECELERATION, 0, "I"),
    (Object.QUICK_STOP_DECELERATION, 0, "I"),
    (Object.MAX_PROFILE_VELOCITY, 0, "I"),
    (Object.MAX_ACCELERATION, 0, "I"),
    (Object.MAX_DECELERATION, 0, "I"),
    (Object.SOFTWARE_POSITION_LIMIT, 1, "i"),
    (Object.SOFTWARE_POSITION_LIMIT, 2, "i"),
    (Object.HOMING_METHOD, 0, "b"),
    (Object.HOMING_SPEEDS, 1, "I"),
    (Object.HOMING_ACCELERATION, 0, "I"),
    (Object.HOME_OFFSET, 0, "i"),
    (Object.INTERPOLATION_TIME_PERIOD, 1, "B"),
    (Object.INTERPOLATION_TIME_PERIOD, 2, "b"),
    (Object.FOLLOWING_ERROR_WINDOW, 0, "I"),
    (Object.POSITION_WINDOW, 0, "I"),
    (Object.POLARITY, 0, "B"),
    (Object.FEED_CONSTANT, 1, "I"),
    (Object.SI_UNIT_POSITION, 0, "I"),
    (Object.TORQUE_SLOPE, 0, "I"),
    (Object.HALT_OPTION, 0, "h"),
    (Object.QUICK_STOP_OPTION, 0, "h"),
    (0x6082, 0, "I"),
    (0x2100, 1, "i"),
    *((MACHINE, sub, "I" if sub in (1, 7) else "B" if sub in (2, 8) else "i") for sub in range(1, 9)),
)
BITS = {"b": (-128, 127), "B": (0, 255), "h": (-0x8000, 0x7FFF), "H": (0, 0xFFFF)}
BITS |= {"i": (-0x8000_0000, 0x7FFF_FFFF), "I": (0, 0xFFFF_FFFF)}


@st.composite
def writes(draw: st.DrawFn) -> tuple[int, int, bytes]:
    """A write of some object: the ends of its type, small values, anything."""
    index, sub, code = draw(st.sampled_from(WRITES))
    low, high = BITS[code]
    small = st.integers(max(low, -200), min(high, 200))
    value = draw(st.one_of(small, st.sampled_from([low, high, 0, 1]), st.integers(low, high)))
    return index, sub, pack("<" + code, value)


WORDS = st.sampled_from([ENABLED, 0x1F, 0x3F, 0x5F, 0x7F, 0x21F, 0x10F, 0x11F, 0x02, 0x06, 0x07, 0x80, 0x00])
STEPS = st.lists(
    st.one_of(writes(), WORDS, st.integers(1, 40).map(float), st.integers(1, 9).map(lambda n: -float(n))),
    max_size=30,
)
"""An SDO write, a controlword, milliseconds, or a mode's number below zero."""
MODE_NUMBERS = (0, 1, 3, 4, 6, 8, 9, 10)


@examples_of(150)
@given(STEPS)
def test_anything_may_be_written_at_any_time(steps: list[tuple[int, int, bytes] | int | float]) -> None:
    bench = MotionBench(mode=10)  # type: ignore[arg-type]
    bench.set(Object.MAX_MOTOR_SPEED, "I", SPEED_MAX_RPM)
    bench.set(0x2100, "i", 0, 1)
    for step in steps:
        if isinstance(step, tuple):
            index, sub, raw = step
            if index == 0x2100:
                raw = pack("<i", int.from_bytes(raw, "little", signed=True) % 500)
            head = pack("<BHB", 0x23 | (4 - len(raw)) << 2, index, sub)
            (answer,) = [
                f for f in bench.receive(Frame(0x601, head + raw.ljust(4, b"\0"))) if f.can_id == 0x581
            ]
            assert answer.data[0] in (0x60, 0x80)
        elif isinstance(step, float):
            if step > 0.0:
                bench.wait_ms(step)
            else:
                bench.write(Object.MODES_OF_OPERATION, "b", MODE_NUMBERS[int(-step) % len(MODE_NUMBERS)])
        else:
            bench.control(step)
        assert {0x181, 0x281} <= {frame.can_id for frame in bench.receive(SYNC)}
        assert bench.state is not None
        assert math.isfinite(bench.speed_rad_s)
        assert abs(bench.speed_rad_s) < 1.3 * SPEED_MAX_RPM * math.tau / 60 + 5.0
    assert bench.write(MACHINE, "B", 1, 8) is None
    assert bench.state in (State.SWITCH_ON_DISABLED, State.FAULT)
