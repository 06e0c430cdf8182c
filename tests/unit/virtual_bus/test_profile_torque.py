"""Profile torque mode over the frames of the whole drive, against closed forms."""

import math

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, State
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import (
    COUNTS,
    ENABLED,
    HALT,
    LIMITED,
    REACHED,
    RPM_PER_TURN_S,
    MotionBench,
)


@pytest.fixture
def bench() -> MotionBench:
    made = MotionBench(Mode.PROFILE_TORQUE, DriveParameters(brake_torque_nm=0.0))
    made.set(Object.TORQUE_SLOPE, "I", 5000)
    return made


def torque(bench: MotionBench) -> int:
    """6077h, per thousand."""
    return bench.read(Object.TORQUE_ACTUAL_VALUE, "h")


def test_the_torque_goes_by_its_slope(bench: MotionBench) -> None:
    bench.set(Object.TARGET_TORQUE, "h", 300)
    for passed in range(1, 65):
        bench.wait_ms(1)
        demand = bench.read(Object.TORQUE_DEMAND, "h")
        assert demand == pytest.approx(min(5.0 * passed, 300), abs=6)
        assert torque(bench) == pytest.approx(demand, abs=8)
    assert bench.reached
    bench.wait_ms(20)
    assert torque(bench) == pytest.approx(300, abs=3)
    bench.set(Object.TARGET_TORQUE, "h", -300)
    bench.wait_ms(2)
    assert not bench.reached
    assert 2 + bench.until_reached() == pytest.approx(600 / 5.0, abs=4)


def test_the_speed_is_the_integral_of_the_torque(bench: MotionBench) -> None:
    bench.set(Object.TARGET_TORQUE, "h", 300)
    bench.wait_ms(100)
    full_nm = 0.3 * LING.rated_torque_nm
    gained = full_nm * (0.1 - 0.06 / 2) / LING.inertia_kg_m2
    friction = 1.0 - LING.viscous_friction_nm_s / LING.inertia_kg_m2 * 0.1 / 3
    assert bench.speed_rad_s == pytest.approx(gained * friction, rel=0.04)


def test_torque_is_cut_at_6072(bench: MotionBench) -> None:
    bench.set(Object.MAX_TORQUE, "H", 200)
    bench.set(Object.TARGET_TORQUE, "h", 500)
    bench.wait_ms(110)
    assert torque(bench) == pytest.approx(200, abs=3)
    assert bench.statusword & (LIMITED | REACHED) == LIMITED


@pytest.mark.parametrize(("option", "deceleration"), [(1, 50.0), (2, 200.0), (3, math.inf)])
def test_halt_brings_the_shaft_to_rest_by_605d(bench: MotionBench, option: int, deceleration: float) -> None:
    bench.profile(10.0, 100.0, 50.0)
    bench.set(Object.QUICK_STOP_DECELERATION, "I", 200 * RPM_PER_TURN_S)
    bench.set(Object.HALT_OPTION, "h", option)
    bench.set(Object.TARGET_TORQUE, "h", 300)
    bench.wait_ms(120)
    speed, begun = bench.turns_s, bench.turns
    assert speed > 5.0
    bench.control(ENABLED | HALT)
    assert not bench.reached
    bench.until_reached()
    assert bench.turns - begun == pytest.approx(speed**2 / (2 * deceleration), abs=0.1)
    assert bench.state is State.OPERATION_ENABLED
    bench.wait_ms(20)
    bench.control(ENABLED)
    bench.wait_ms(21)
    assert bench.read(Object.TORQUE_DEMAND, "h") == pytest.approx(100, abs=10), "the ramp begins anew"


def test_the_mode_begins_with_the_torque_that_there_is(bench: MotionBench) -> None:
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.CYCLIC_SYNCHRONOUS_TORQUE)
    bench.set(Object.TARGET_TORQUE, "h", 300)
    bench.wait_ms(10)
    bench.set(Object.TARGET_TORQUE, "h", 300)
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.PROFILE_TORQUE)
    assert min(bench.watch(20, lambda: bench.read(Object.TORQUE_DEMAND, "h"))) == 300


def test_a_limit_switch_and_the_software_limit_hold_the_shaft_and_let_it_go_back(bench: MotionBench) -> None:
    for kind in ("switch", "range"):
        if kind == "switch":
            bench.fit(0b10, positive=2.0)
        else:
            bench.fit(0)
            bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", -20 * COUNTS, 1)
            bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 2 * COUNTS, 2)
        bench.set(Object.TARGET_TORQUE, "h", 200)
        bench.wait_ms(700)
        assert bench.statusword & LIMITED, kind
        assert abs(bench.turns_s) < 0.05
        assert 1.95 < bench.turns < 3.0
        bench.set(Object.TARGET_TORQUE, "h", -100)
        bench.wait_ms(400)
        assert bench.turns < 1.5
        assert not bench.statusword & LIMITED
        bench.set(Object.TARGET_TORQUE, "h", 0)
        bench.control(ENABLED | HALT)
        bench.until_reached()
        bench.control(ENABLED)
        bench.wait_ms(20)
