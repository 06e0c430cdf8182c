"""Friction by bristles (LuGre) beside solve_ivp's Radau, Dahl's closed form of what bends before it slips,
and the curve that it slips by."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from servobench.design.mechanism import Coupling, Friction, Mechanism, PlacedLoad, Side
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters
from tests.motors import LING
from tests.plant import Plant

PERIOD_S = 1.0 / 16_000
FloatArray = NDArray[np.float64]
DEAD = replace(LING, flux_linkage_wb=1e-12, viscous_friction_nm_s=0.0, coulomb_friction_nm=0.1)
STRIBECK = 0.5


def lugre(
    friction: Friction, coulomb_nm: float, rubbed_kg_m2: float, z: float, w: float
) -> tuple[float, float]:
    """dz/dt and the torque."""
    low = coulomb_nm if w > 0.0 else friction.backward_nm
    bears = low + (friction.breakaway_nm - coulomb_nm) / (1.0 + (w / friction.stribeck_rad_s) ** 2)
    k = friction.bristle_nm_rad
    slope = w - k * abs(w) / bears * z
    damping = 2.0 * friction.bristle_damping_ratio * math.sqrt(k * rubbed_kg_m2)
    return slope, k * z + damping * slope


@pytest.mark.parametrize(
    ("side", "stiffness"), [(Side.LOAD, 700.0), (Side.LOAD, 2000.0), (Side.MOTOR, 600.0)]
)
def test_stick_and_slip_on_bristles_are_those_of_radau(side: Side, stiffness: float) -> None:
    """A heavy mass pulls a light one by a soft shaft; both ways, as the weight's side changes."""
    heavy, light = 0.9996, 0.0004
    motor = replace(DEAD, inertia_kg_m2=1.0)
    masses = (heavy, light) if side is Side.LOAD else (light, heavy)
    shaft = Coupling(*masses, 8.0, 0.0)
    friction = Friction(0.3, STRIBECK, 0.2, side, 0.0, stiffness, 0.7)
    plant = Plant(replace(motor, mechanism=Mechanism(shaft, friction)))
    start = (0.6, 0.0) if side is Side.LOAD else (0.0, 0.6)
    plant.spin(*start)

    def slopes(_: float, x: FloatArray) -> list[float]:
        rotor, load, twist, z = x
        bends, rubs = lugre(friction, 0.1, light, z, rotor if side is Side.MOTOR else load)
        on_rotor, on_load = (rubs, 0.0) if side is Side.MOTOR else (0.0, rubs)
        passed = 8.0 * twist
        return [
            (-passed - on_rotor) / masses[0],
            (passed - on_load) / masses[1],
            rotor - load,
            bends,
        ]

    at_s = np.arange(1, 4001) * PERIOD_S
    solved = solve_ivp(
        slopes, (0.0, at_s[-1]), [*start, 0.0, 0.0], method="Radau", t_eval=at_s, rtol=1e-7, atol=1e-10
    )
    found = []
    for _ in at_s:
        plant.advance(0.0, 0.0)
        found.append([plant.speed_rad_s, plant.load_speed_rad_s, plant.twist_rad])
    expected = solved.y[:3].T
    rms = np.sqrt(np.mean((np.array(found) - expected) ** 2, axis=0)) / np.abs(expected).max(axis=0)
    slow = float(np.mean(np.abs(expected[:, 1 if side is Side.LOAD else 0]) < 0.02))
    print(f"{100 * slow:.0f} % of the time sticking, rms {rms.max():.1e} of the peak")
    assert 0.2 < slow < 0.9
    assert rms.max() < 1e-3


def test_bristles_bend_by_the_closed_form_of_dahl() -> None:
    """With one friction for all speeds, k z = g (1 - exp(-k x / g)) going up, and from where it turned going
    back; slowly, as the bristles' damping is not in it."""
    g, k = 0.1, 50.0
    plant = Plant(replace(DEAD, mechanism=Mechanism(friction=Friction(g, STRIBECK, g, Side.MOTOR, 0.0, k))))
    place, told = 0.0, []
    for load_nm in (*np.linspace(0.0, 0.09, 80000), *np.linspace(0.09, -0.09, 160000)):
        plant.advance(0.0, 0.0, -load_nm)
        place += plant.speed_rad_s * PERIOD_S
        told.append(place)
    up, back = told[79999], told[-1]
    turned = -g / k * math.log(1.0 - 0.09 / g)
    assert up == pytest.approx(turned, rel=0.01)
    assert back == pytest.approx(turned - g / k * math.log((g + 0.09) / (g - 0.09)), abs=0.01 * turned)


@pytest.mark.parametrize(("speed_rad_s", "coulomb_nm"), [(2.0, 0.1), (0.3, 0.1), (-2.0, 0.15), (-40.0, 0.15)])
def test_bristles_slip_by_the_curve_of_the_friction(speed_rad_s: float, coulomb_nm: float) -> None:
    heavy = replace(DEAD, inertia_kg_m2=10.0)
    friction = Friction(0.25, 3.0, 0.15, Side.MOTOR, 0.0, 500.0)
    plant = Plant(replace(heavy, mechanism=Mechanism(friction=friction)))
    plant.spin(speed_rad_s)
    plant.advance(0.0, 0.0, periods=1600)
    before = plant.speed_rad_s
    plant.advance(0.0, 0.0, periods=160)
    middle = 0.5 * (before + plant.speed_rad_s)
    expected = coulomb_nm + 0.15 / (1.0 + (middle / 3.0) ** 2)
    assert abs(plant.speed_rad_s - before) / (160 * PERIOD_S) * 10.0 == pytest.approx(expected, rel=1e-3)


def test_a_load_is_held_by_bristles_up_to_what_a_start_takes() -> None:
    """The share of the load that rubs is in it, and a weight acts by its place."""
    for weight_nm, moves in ((0.29, False), (0.33, True)):
        friction = Friction(0.25, 3.0, 0.1, Side.MOTOR, 0.2, 500.0)
        mechanism = Mechanism(friction=friction, load=PlacedLoad(weight_nm))
        plant = Plant(replace(DEAD, mechanism=mechanism))
        plant.advance(0.0, 0.0, periods=8000)
        assert (abs(plant.speed_rad_s) > 0.1) is moves


def test_a_brake_and_bristles_hold_a_load_together() -> None:
    """At rest the brake holds what bent bristles leave; relieved, they push it back as far as it lets."""
    friction = Friction(0.25, 3.0, 0.1, Side.MOTOR, 0.0, 500.0)  # 0.35 N m backwards
    for load_nm, moves in ((0.4, False), (0.5, False), (0.57, True)):
        drive = FirmwareParameters(brake_torque_nm=0.2)
        firmware = Firmware(replace(LING, mechanism=Mechanism(friction=friction)), drive)
        firmware.start(Instant(0))
        places = []
        for end, asked_nm in ((1, load_nm), (2, 0.0)):
            firmware.inner.load_nm = asked_nm
            firmware.advance_to(Instant(end * 10**9))
            places.append(firmware.inner.turns * math.tau + firmware.inner.angle_rad)
            assert (abs(firmware.speed_rad_s) > 1e-6) is (moves and end == 1)
        if not moves:
            assert firmware.inner.bristle_rad == pytest.approx(-0.2 / 500.0, rel=0.2)
            assert places[0] < places[1] < 0.0
