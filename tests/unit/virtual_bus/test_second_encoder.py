"""60E4h to 60EEh: the encoder on the other side of the coupling, beside the twist by the torque that it
passes on.
"""

import math
from dataclasses import replace

import pytest

from servobench.design.mechanism import Coupling, Mechanism, PlacedLoad, Side
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.virtual_bus.drive.machine import ADDITIONAL_FACTORS, ADDITIONAL_VELOCITY
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import COUNTS, MotionBench

WEIGHT_NM, STIFFNESS = 0.6, 60.0
HALF = 0.5 * LING.inertia_kg_m2


def bench_of(encoder: Side, second: bool = True) -> MotionBench:
    shaft = Coupling(HALF, HALF, STIFFNESS, 0.3, encoder=encoder, second_encoder=second)
    mechanism = Mechanism(shaft, load=PlacedLoad(WEIGHT_NM))
    return MotionBench(Mode.PROFILE_VELOCITY, motor=replace(LING, mechanism=mechanism))


def apart(bench: MotionBench) -> float:
    """The second encoder beyond the first, counts."""
    return bench.read(Object.ADDITIONAL_POSITION, "i", 1) - bench.read(Object.POSITION_ACTUAL_VALUE, "i")


@pytest.mark.parametrize(("encoder", "sign"), [(Side.MOTOR, -1.0), (Side.LOAD, 1.0)])
def test_both_encoders_are_apart_by_the_twist(encoder: Side, sign: float) -> None:
    """A weight at rest, then the load's inertia beside it, and the home of both is one."""
    bench = bench_of(encoder)
    bench.wait_ms(300)
    per_nm = sign * COUNTS / math.tau / STIFFNESS
    assert apart(bench) == pytest.approx(per_nm * WEIGHT_NM, abs=3.0)
    bench.profile(20.0, 40.0, 40.0)
    bench.speed(20.0)
    bench.wait_ms(300)
    passed_nm = WEIGHT_NM + HALF * 40.0 * math.tau
    assert apart(bench) == pytest.approx(per_nm * passed_nm, abs=6.0)
    assert bench.turns > 1.0
    bench.speed(0.0)
    bench.wait_ms(1500)
    before = apart(bench)
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.HOMING)
    bench.set(Object.HOMING_METHOD, "b", 35)
    bench.control(0x1F)
    bench.wait_ms(50)
    assert abs(bench.turns) < 0.01
    assert apart(bench) == pytest.approx(before, abs=3.0)


@pytest.mark.parametrize("encoder", Side)
def test_its_speed_is_that_of_its_side_in_the_units_of_the_first(encoder: Side) -> None:
    """CiA 402-2, additional velocity actual value; while the shaft swings both sides differ."""
    bench = bench_of(encoder)
    bench.profile(20.0, 400.0, 400.0)
    bench.speed(20.0)
    seen = set()
    for _ in range(20):
        bench.wait_ms(1)
        inner = bench.servo.drive.firmware.inner
        there = inner.load_speed_rad_s if encoder is Side.MOTOR else inner.speed_rad_s
        assert bench.read(ADDITIONAL_VELOCITY, "i", 1) == pytest.approx(there * 30_000.0 / math.pi, abs=1.0)
        seen.add(abs(inner.load_speed_rad_s - inner.speed_rad_s) > 0.5)
    assert True in seen


def test_its_factors_are_those_by_which_its_position_is_scaled() -> None:
    """CiA 402-2: 60E4h by 60E6h and 60EBh, 60E8h and 60EDh, 60E9h and 60EEh, as 6064h by the first's."""
    bench = bench_of(Side.MOTOR)
    bench.control(0x06)
    for sub, gear, feed in ((1, 5, 3600), (2, 2, 7)):
        bench.set(Object.GEAR_RATIO, "I", gear, sub)
        bench.set(Object.FEED_CONSTANT, "I", feed, sub)
    told = {index: bench.read(index, "I", 1) for index in ADDITIONAL_FACTORS}
    assert told == {0x60E6: COUNTS, 0x60EB: 1, 0x60E8: 5, 0x60ED: 2, 0x60E9: 3600, 0x60EE: 7}
    inner = bench.servo.drive.firmware.inner
    load_turns = inner.turns + (inner.angle_rad - inner.twist_rad) / math.tau
    assert bench.read(Object.ADDITIONAL_POSITION, "i", 1) == pytest.approx(
        load_turns * 2 / 5 * 3600 / 7, abs=1.0
    )
    assert bench.write(0x60E6, "I", 1, 1) is not None, "it is what it is"


def test_a_machine_with_one_encoder_has_no_second_position() -> None:
    assert bench_of(Side.MOTOR, second=False).servo.dictionary.get(Object.ADDITIONAL_POSITION, 1) is None
