"""60E4h, the encoder on the other side of the coupling, beside the twist by the torque that it passes on."""

import math
from dataclasses import replace

import pytest

from servobench.design.mechanism import Coupling, Mechanism, PlacedLoad, Side
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.virtual_bus.drive.machine import ADDITIONAL_POSITION
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
    return bench.read(ADDITIONAL_POSITION, "i", 1) - bench.read(Object.POSITION_ACTUAL_VALUE, "i")


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


def test_a_machine_with_one_encoder_has_no_second_position() -> None:
    assert bench_of(Side.MOTOR, second=False).servo.dictionary.get(ADDITIONAL_POSITION, 1) is None
