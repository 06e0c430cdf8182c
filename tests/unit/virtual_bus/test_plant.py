"""The plant against closed forms: decay, friction that sticks, load, turns without end."""

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.virtual_bus.core.native import sine_cosine
from tests.draws import examples_of
from tests.motors import AZAIZ, LING
from tests.plant import Plant

PERIOD_S = 1.0 / 16_000
STICKY = replace(LING, coulomb_friction_nm=0.2, flux_linkage_wb=1e-9)
"""A shaft with Coulomb friction and next to no torque of its own."""


@examples_of(500)
@given(st.floats(-1000.0, 1000.0))
def test_sine_and_cosine(angle: float) -> None:
    sine, cosine = sine_cosine(angle)
    assert sine == pytest.approx(math.sin(angle), abs=4e-16)
    assert cosine == pytest.approx(math.cos(angle), abs=4e-16)


def test_locked_current_rises_with_the_electrical_time_constant() -> None:
    heavy = replace(LING, inertia_kg_m2=1e6)
    plant = Plant(heavy)
    for _ in range(100):
        plant.advance(0.0, 10.0)
    time_constant_s = LING.inductance_q_h / LING.resistance_ohm
    expected = 10.0 / LING.resistance_ohm * (1.0 - math.exp(-100 * PERIOD_S / time_constant_s))
    assert plant.current_q_a == pytest.approx(expected, rel=1e-6)
    assert plant.current_d_a == pytest.approx(0.0, abs=1e-6)


def test_each_axis_has_its_own_inductance() -> None:
    heavy = replace(AZAIZ, inertia_kg_m2=1e6)
    plant = Plant(heavy)
    plant.advance(3.0, 3.0)
    assert plant.current_d_a / plant.current_q_a == pytest.approx(2.0, rel=0.02)


def test_viscous_friction_alone_is_an_exponential() -> None:
    plant = Plant(replace(LING, flux_linkage_wb=1e-9))
    plant.spin(150.0)
    for _ in range(4800):
        plant.advance(0.0, 0.0)
    rate = LING.viscous_friction_nm_s / LING.inertia_kg_m2
    assert plant.speed_rad_s == pytest.approx(150.0 * math.exp(-0.3 * rate), rel=1e-9)
    turned = plant.turns * math.tau + plant.angle_rad
    assert turned == pytest.approx(150.0 / rate * (1.0 - math.exp(-0.3 * rate)), rel=1e-9)


@pytest.mark.parametrize("load_nm", [0.19, -0.19, 0.2])
def test_a_resting_shaft_sticks_below_its_friction(load_nm: float) -> None:
    plant = Plant(STICKY)
    for _ in range(1600):
        plant.advance(0.0, 0.0, load_nm)
    assert plant.speed_rad_s == 0.0
    assert plant.angle_rad == 0.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_exceeds_the_friction_moves_the_shaft(sign: float) -> None:
    plant = Plant(replace(STICKY, viscous_friction_nm_s=0.0))
    for _ in range(1600):
        plant.advance(0.0, 0.0, sign * 0.3)
    assert plant.speed_rad_s == pytest.approx(-sign * 0.1 / LING.inertia_kg_m2 * 0.1, rel=1e-9)


def test_a_shaft_thrown_against_the_load_turns_round() -> None:
    plant = Plant(replace(STICKY, viscous_friction_nm_s=0.0))
    plant.spin(50.0)
    for _ in range(3200):
        plant.advance(0.0, 0.0, 0.3)
    stop_s = 50.0 * LING.inertia_kg_m2 / 0.5
    assert plant.speed_rad_s == pytest.approx(-(0.2 - stop_s) * 0.1 / LING.inertia_kg_m2, rel=1e-6)


def test_friction_never_drives_the_shaft() -> None:
    plant = Plant(STICKY)
    plant.spin(20.0)
    speeds = []
    for _ in range(3200):
        plant.advance(0.0, 0.0)
        speeds.append(plant.speed_rad_s)
    assert all(0.0 <= later <= earlier for earlier, later in itertools.pairwise(speeds))
    assert speeds[-1] == 0.0


def test_turns_are_counted_both_ways() -> None:
    plant = Plant(replace(LING, viscous_friction_nm_s=0.0, flux_linkage_wb=1e-9))
    for speed in (400.0, -400.0, -400.0):
        plant.spin(speed)
        for _ in range(16_000):
            plant.advance(0.0, 0.0)
        assert 0.0 <= plant.angle_rad < math.tau
    assert plant.turns * math.tau + plant.angle_rad == pytest.approx(-400.0, rel=1e-9)


def test_saliency_adds_torque_with_negative_d_current() -> None:
    motor = replace(AZAIZ, viscous_friction_nm_s=0.0, inertia_kg_m2=1e3)
    plant = Plant(motor)
    for _ in range(3200):
        plant.advance(-10.0 * motor.resistance_ohm, 8.0 * motor.resistance_ohm)
    before = plant.speed_rad_s
    for _ in range(1600):
        plant.advance(-10.0 * motor.resistance_ohm, 8.0 * motor.resistance_ohm)
    torque = (plant.speed_rad_s - before) / 0.1 * motor.inertia_kg_m2
    i_d, i_q = plant.current_d_a, plant.current_q_a
    magnet = 1.5 * 4 * 0.12 * i_q
    reluctance = 1.5 * 4 * (0.0014 - 0.0028) * i_d * i_q
    assert i_d == pytest.approx(-10.0, rel=0.01)
    assert reluctance > 0.1 * magnet
    assert torque == pytest.approx(magnet + reluctance, rel=1e-3)
