"""The option codes 605Ah..605Eh with a turning shaft: how it stops, and in which state that ends."""

import math

import pytest

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import FOLLOW_BITS, Mode, State, Status
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import ENABLED, RPM_PER_TURN_S, MotionBench

SPEED, DOWN, QUICK, HOMING = 10.0, 50.0, 200.0, 80.0
"""turns/s, turns/s^2."""
COAST, RAMP, QUICK_RAMP, LIMIT = "coast", "slow down ramp", "quick stop ramp", "current limit"
STEEPNESS = {RAMP: DOWN, QUICK_RAMP: QUICK, LIMIT: math.inf}
TURNING = (
    Mode.PROFILE_POSITION,
    Mode.PROFILE_VELOCITY,
    Mode.PROFILE_TORQUE,
    Mode.VELOCITY,
    Mode.INTERPOLATED_POSITION,
    Mode.CYCLIC_SYNCHRONOUS_POSITION,
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
    Mode.CYCLIC_SYNCHRONOUS_TORQUE,
)

STREAMED = {
    Mode.CYCLIC_SYNCHRONOUS_POSITION: (Object.TARGET_POSITION, 0),
    Mode.INTERPOLATED_POSITION: (Object.INTERPOLATION_DATA_RECORD, 1),
}
RAMPS = {
    Object.VL_VELOCITY_ACCELERATION: 500.0,
    Object.VL_VELOCITY_DECELERATION: DOWN,
    Object.VL_VELOCITY_QUICK_STOP: QUICK,
}


def bench_word(mode: Mode) -> int:
    """With which a mode follows."""
    return ENABLED | FOLLOW_BITS.get(mode, 0)


def turning_bench(mode: Mode = Mode.PROFILE_VELOCITY) -> MotionBench:
    """The shaft turns at SPEED in whatever mode."""
    bench = MotionBench(Mode.PROFILE_VELOCITY, DriveParameters(brake_torque_nm=0.0))
    bench.profile(SPEED, 500.0, DOWN)
    bench.set(Object.QUICK_STOP_DECELERATION, "I", round(QUICK * RPM_PER_TURN_S))
    bench.set(Object.HOMING_ACCELERATION, "I", round(HOMING * RPM_PER_TURN_S))
    bench.set(Object.HOMING_SPEEDS, "I", round(SPEED * RPM_PER_TURN_S * 1000), 1)
    bench.speed(SPEED)
    bench.wait_ms(100)
    if mode is Mode.PROFILE_POSITION:
        bench.set(Object.MODES_OF_OPERATION, "b", mode)
        bench.target(100.0)
        bench.wait_ms(150)
    elif mode is Mode.HOMING:
        bench.set(Object.HOMING_METHOD, "b", 18)
        bench.set(Object.MODES_OF_OPERATION, "b", mode)
        bench.control(ENABLED | 0x10)
        bench.wait_ms(200)
    elif mode in STREAMED:
        index, sub = STREAMED[mode]
        start = bench.read(0x6064, "i")
        bench.set(index, "i", start, sub)
        bench.set(Object.MODES_OF_OPERATION, "b", mode)
        bench.control(bench_word(mode))
        for place in range(1, 100):
            bench.set(index, "i", start + round(place * SPEED * 65.536), sub)
            bench.wait_ms(1)
    elif mode is Mode.VELOCITY:
        bench.set(Object.VL_TARGET_VELOCITY, "h", round(SPEED * RPM_PER_TURN_S))
        for index, steepness in RAMPS.items():
            bench.set(index, "I", round(steepness * RPM_PER_TURN_S), 1)
        bench.set(Object.MODES_OF_OPERATION, "b", mode)
        bench.control(bench_word(mode))
        bench.wait_ms(50)
    else:
        bench.set(Object.MODES_OF_OPERATION, "b", mode)
        bench.wait_ms(1)
    assert bench.turns_s == pytest.approx(SPEED, rel=0.06)
    return bench


def stopped(bench: MotionBench, how: str, final: State, started: float, begun: float) -> None:
    """Check way and end of a stop that has just begun at ``started`` turns/s and ``begun`` turns."""
    if how == COAST:
        assert bench.shows(final)
        bench.wait_ms(100)
        decay = math.exp(-0.1 * LING.viscous_friction_nm_s / LING.inertia_kg_m2)
        assert bench.turns_s == pytest.approx(started * decay, rel=0.03)
        return
    bench.wait_until(lambda: bench.shows(final) and abs(bench.turns_s) < 0.2, 1500)
    way = started**2 / (2 * STEEPNESS[how])
    assert bench.turns - begun == pytest.approx(way, abs=0.09)


@pytest.mark.parametrize(
    ("option", "how", "final"),
    [
        (0, COAST, State.SWITCH_ON_DISABLED),
        (1, RAMP, State.SWITCH_ON_DISABLED),
        (2, QUICK_RAMP, State.SWITCH_ON_DISABLED),
        (3, LIMIT, State.SWITCH_ON_DISABLED),
        (4, LIMIT, State.SWITCH_ON_DISABLED),
        (5, RAMP, State.QUICK_STOP),
        (6, QUICK_RAMP, State.QUICK_STOP),
        (7, LIMIT, State.QUICK_STOP),
        (8, LIMIT, State.QUICK_STOP),
    ],
)
def test_quick_stop_by_605a(option: int, how: str, final: State) -> None:
    bench = turning_bench()
    bench.set(Object.QUICK_STOP_OPTION, "h", option)
    started, begun = bench.turns_s, bench.turns
    bench.control(0x02)
    if how != COAST:
        assert bench.shows(State.QUICK_STOP)
        assert not bench.statusword & Status.TARGET_REACHED
    stopped(bench, how, final, started, begun)
    if final is State.QUICK_STOP:
        bench.wait_ms(100)
        assert bench.statusword & Status.TARGET_REACHED
        assert bench.shows(State.QUICK_STOP)
        bench.speed(0.0)
        bench.control(ENABLED)
        assert bench.shows(State.OPERATION_ENABLED), "arrow 16"


@pytest.mark.parametrize(("option", "how"), [(0, COAST), (1, RAMP)])
@pytest.mark.parametrize(
    ("index", "controlword", "final"),
    [
        (Object.SHUTDOWN_OPTION, 0x06, State.READY),
        (Object.DISABLE_OPERATION_OPTION, 0x07, State.SWITCHED_ON),
    ],
)
def test_shutdown_by_605b_and_disable_operation_by_605c(
    index: Object, controlword: int, final: State, option: int, how: str
) -> None:
    bench = turning_bench()
    bench.set(index, "h", option)
    started, begun = bench.turns_s, bench.turns
    bench.control(controlword)
    if how != COAST:
        assert bench.shows(State.OPERATION_ENABLED), "the state follows when the shaft rests"
    stopped(bench, how, final, started, begun)


@pytest.mark.parametrize(("option", "how"), [(0, COAST), (1, RAMP), (2, QUICK_RAMP), (3, LIMIT), (4, LIMIT)])
def test_fault_reaction_by_605e(option: int, how: str) -> None:
    bench = turning_bench()
    bench.set(Object.FAULT_REACTION_OPTION, "h", option)
    started, begun = bench.turns_s, bench.turns
    bench.servo.drive.fail(0x4310, ErrorRegister.TEMPERATURE)
    assert bench.shows(State.FAULT if how == COAST else State.FAULT_REACTION)
    stopped(bench, how, State.FAULT, started, begun)
    assert bench.read(Object.ERROR_CODE, "H") == 0x4310


@pytest.mark.parametrize("mode", [*TURNING, Mode.HOMING])
def test_the_slow_down_ramp_of_each_mode(mode: Mode) -> None:
    """6084h, but in homing 609Ah, and in velocity mode 6049h."""
    bench = turning_bench(mode)
    if mode is Mode.VELOCITY:
        bench.set(Object.PROFILE_DECELERATION, "I", round(2 * DOWN * RPM_PER_TURN_S))
    bench.set(Object.QUICK_STOP_OPTION, "h", 1)
    started, begun = bench.turns_s, bench.turns
    bench.control(0x02)
    bench.wait_until(lambda: bench.shows(State.SWITCH_ON_DISABLED), 1500)
    steepness = HOMING if mode is Mode.HOMING else DOWN
    assert bench.turns - begun == pytest.approx(started**2 / (2 * steepness), rel=0.06)


@pytest.mark.parametrize("mode", TURNING)
def test_a_stop_called_off_goes_on_from_the_present_speed(mode: Mode) -> None:
    bench = turning_bench(mode)
    if mode in STREAMED:
        return  # their set-points stay behind meanwhile
    bench.control(0x07)
    bench.wait_ms(40)
    speed = bench.turns_s
    assert speed == pytest.approx(SPEED - 0.04 * DOWN, rel=0.1)
    bench.control(bench_word(mode))
    assert bench.shows(State.OPERATION_ENABLED)
    bench.wait_ms(1)
    assert bench.turns_s == pytest.approx(speed, abs=1.2)


def test_the_quick_stop_ramp_of_velocity_mode_is_604a() -> None:
    bench = turning_bench(Mode.VELOCITY)
    bench.set(Object.QUICK_STOP_DECELERATION, "I", round(DOWN * RPM_PER_TURN_S))
    started, begun = bench.turns_s, bench.turns
    bench.control(0x02)
    stopped(bench, QUICK_RAMP, State.SWITCH_ON_DISABLED, started, begun)


def test_a_steeper_quick_stop_is_not_weakened_by_60c6() -> None:
    bench = turning_bench()
    bench.set(Object.MAX_DECELERATION, "I", 10 * RPM_PER_TURN_S)
    begun, started = bench.turns, bench.turns_s
    bench.control(0x02)
    stopped(bench, QUICK_RAMP, State.SWITCH_ON_DISABLED, started, begun)
