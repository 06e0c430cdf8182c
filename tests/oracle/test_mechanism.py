"""Coupling, backlash, friction and cogging of the core against scipy: a matrix exponential, energy, solve_ivp
with events, the friction's steady map and a spectrum. The motor is dead: mechanics are all there is."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from servobench.design.mechanism import CoggingHarmonic, Coupling, Friction, Mechanism, PlacedLoad, Side
from servobench.design.motor import PmsmParameters
from tests.motors import LING
from tests.plant import Plant

PERIOD_S = 1.0 / 16_000
FloatArray = NDArray[np.float64]
DEAD = replace(LING, flux_linkage_wb=1e-12, viscous_friction_nm_s=0.0)


def coupled(ratio: float, resonance_hz: float, damping: float, backlash_rad: float = 0.0) -> Coupling:
    """The motor's inertia, parted between rotor and load."""
    motor_kg_m2 = DEAD.inertia_kg_m2 / (1.0 + ratio)
    load_kg_m2 = DEAD.inertia_kg_m2 - motor_kg_m2
    reduced = motor_kg_m2 * load_kg_m2 / DEAD.inertia_kg_m2
    stiffness = reduced * (math.tau * resonance_hz) ** 2
    return Coupling(motor_kg_m2, load_kg_m2, stiffness, damping, backlash_rad)


def plant_of(mechanism: Mechanism, motor: PmsmParameters = DEAD) -> Plant:
    return Plant(replace(motor, mechanism=mechanism))


def observe(plant: Plant) -> list[float]:
    return [plant.speed_rad_s, plant.load_speed_rad_s, plant.twist_rad]


@pytest.mark.parametrize("damping", [0.0, 0.02])
@pytest.mark.parametrize("ratio", [0.25, 1.0, 4.0])
@pytest.mark.parametrize("resonance_hz", [20.0, 100.0, 250.0, 380.0, 500.0])
def test_two_masses_are_the_matrix_exponential(resonance_hz: float, ratio: float, damping: float) -> None:
    """Over 50 ms from a twisting blow, with a torque on the load."""
    shaft, load_nm = coupled(ratio, resonance_hz, damping), 0.7
    k, d, m, j = shaft.stiffness_nm_rad, shaft.damping_nm_s, shaft.motor_kg_m2, shaft.load_kg_m2
    a = np.array([[-d / m, d / m, -k / m, 0], [d / j, -d / j, k / j, -load_nm / j], [1, -1, 0, 0], [0] * 4])
    transition = expm(PERIOD_S * a)
    plant = plant_of(Mechanism(shaft))
    plant.spin(20.0, 0.0)
    x, found, expected = np.array([20.0, 0.0, 0.0, 1.0]), [], []
    for _ in range(800):
        plant.advance(0.0, 0.0, load_nm)
        x = transition @ x
        found.append(observe(plant))
        expected.append(x[:3])
    error = np.abs(np.array(found) - expected).max(axis=0) / np.abs(expected).max(axis=0)
    print(f"largest error {error.max():.1e}")
    assert error.max() < 1e-3


@pytest.mark.parametrize("resonance_hz", [50.0, 150.0, 212.0, 250.0])
def test_energy_goes_nowhere_but_into_the_damper(resonance_hz: float) -> None:
    shaft = coupled(1.0, resonance_hz, 0.02)
    plant = plant_of(Mechanism(shaft))
    plant.spin(20.0, 0.0)

    def energy() -> float:
        rotor, load, twist = observe(plant)
        kinetic = shaft.motor_kg_m2 * rotor**2 + shaft.load_kg_m2 * load**2
        return 0.5 * (kinetic + shaft.stiffness_nm_rad * twist**2)

    before = energy()
    power = [shaft.damping_nm_s * 20.0**2]
    slopes = []
    for _ in range(800):
        plant.advance(0.0, 0.0)
        rotor, load, twist = observe(plant)
        twisting = rotor - load
        power.append(shaft.damping_nm_s * twisting**2)
        passed = shaft.stiffness_nm_rad * twist + shaft.damping_nm_s * twisting
        reduced = shaft.motor_kg_m2 * shaft.load_kg_m2 / DEAD.inertia_kg_m2
        slopes.append(-2.0 * shaft.damping_nm_s * twisting * passed / reduced)
    # trapezoids with Euler and Maclaurin's correction at the ends
    first = -2.0 * shaft.damping_nm_s * 20.0 * shaft.damping_nm_s * 20.0 / reduced
    lost = float(np.trapezoid(power, dx=PERIOD_S)) - PERIOD_S**2 / 12.0 * (slopes[-1] - first)
    print(f"balance {abs(before - energy() - lost) / before:.1e} of the energy")
    assert abs(before - energy() - lost) < 1e-6 * before


@pytest.mark.parametrize("speed_rad_s", [3.0, 7.7, 20.0, 31.0])
def test_a_contact_is_made_when_the_play_is_over(speed_rad_s: float) -> None:
    """Rotor alone across half of the play; what it is pressed in at the end tells when it began."""
    shaft = coupled(1.0, 120.0, 0.0, backlash_rad=0.004)
    plant = plant_of(Mechanism(shaft))
    plant.spin(speed_rad_s, 0.0)
    exact_s = 0.002 / speed_rad_s
    periods = math.floor(exact_s / PERIOD_S) + 1
    for _ in range(periods):
        plant.advance(0.0, 0.0)
    omega = math.tau * shaft.resonance_hz
    pressed = plant.twist_rad - 0.002
    began_s = periods * PERIOD_S - math.asin(omega * pressed / speed_rad_s) / omega
    print(f"{abs(began_s - exact_s) * 1e9:.2f} ns")
    assert began_s == pytest.approx(exact_s, abs=1e-7)


@dataclass
class Reference:
    """Two masses, play and friction of the load by solve_ivp: one integration for each phase."""

    shaft: Coupling
    coulomb_nm: float = 0.0
    breakaway_nm: float = 0.0
    stribeck_rad_s: float = 1.0
    flank: int = 0
    way: int = 1
    contacts: int = 0
    rests: int = 0

    def friction(self, way: int, speed: float) -> float:
        extra = self.breakaway_nm - self.coulomb_nm
        return way * (self.coulomb_nm + extra / (1.0 + (speed / self.stribeck_rad_s) ** 2))

    def torque(self, x: FloatArray) -> float:
        if self.shaft.backlash_rad and not self.flank:
            return 0.0
        twist = x[2] - self.flank * self.shaft.backlash_rad / 2.0
        return float(self.shaft.stiffness_nm_rad * twist + self.shaft.damping_nm_s * (x[0] - x[1]))

    def slopes(self, x: FloatArray, motor_nm: float, load_nm: float) -> list[float]:
        passed = self.torque(x)
        net = passed - load_nm - (self.friction(self.way, x[1]) if self.coulomb_nm else 0.0)
        slope = net / self.shaft.load_kg_m2 if self.way or not self.coulomb_nm else 0.0
        return [(motor_nm - passed) / self.shaft.motor_kg_m2, slope, x[0] - x[1]]

    def events(self, load_nm: float) -> list[tuple[str, Callable[[float, FloatArray], float]]]:
        half, found = self.shaft.backlash_rad / 2.0, []
        if half and self.flank:
            found.append(("open", lambda _, x: self.flank * self.torque(x)))
        elif half:
            found.append(("upper", lambda _, x: half - x[2]))
            found.append(("lower", lambda _, x: half + x[2]))
        if self.coulomb_nm and self.way:
            found.append(("rest", lambda _, x: self.way * x[1]))
        elif self.coulomb_nm:
            found.append(("break", lambda _, x: self.breakaway_nm - abs(self.torque(x) - load_nm)))
        for _, event in found:
            event.terminal, event.direction = True, -1  # type: ignore[attr-defined]
        return found

    def advance(self, x: FloatArray, duration_s: float, motor_nm: float, load_nm: float) -> FloatArray:
        left = duration_s
        while left > 0.0:
            events = self.events(load_nm)
            solution = solve_ivp(
                lambda _, x: self.slopes(x, motor_nm, load_nm),
                (0.0, left),
                x,
                method="Radau" if self.coulomb_nm else "DOP853",
                rtol=1e-9,
                atol=1e-12,
                events=[event for _, event in events],
            )
            x, left = solution.y[:, -1].copy(), left - solution.t[-1]
            for (name, _), times in zip(events, solution.t_events, strict=True):
                if len(times):
                    self.turn(name, x, load_nm)
        return x

    def turn(self, name: str, x: FloatArray, load_nm: float) -> None:
        if name in ("upper", "lower"):
            self.flank = 1 if name == "upper" else -1
            self.contacts += 1
        elif name == "open":
            self.flank = 0
        elif name == "rest":
            x[1] = 0.0
            pull = self.torque(x) - load_nm
            self.way = 0 if abs(pull) <= self.breakaway_nm else int(math.copysign(1, pull))
            self.rests += self.way == 0
        else:
            self.way = int(math.copysign(1, self.torque(x) - load_nm))


@pytest.mark.parametrize("damping", [0.02, 0.2])
def test_rattling_in_the_play_is_that_of_solve_ivp(damping: float) -> None:
    shaft = coupled(1.0, 150.0, damping, backlash_rad=0.003)
    plant, reference = plant_of(Mechanism(shaft)), Reference(shaft)
    plant.spin(1.0, 0.0)
    x, found, expected = np.array([1.0, 0.0, 0.0]), [], []
    for period in range(1600):
        load_nm = 0.3 if period // 200 % 2 else -0.3
        plant.advance(0.0, 0.0, load_nm)
        x = reference.advance(x, PERIOD_S, 0.0, load_nm)
        found.append(observe(plant))
        expected.append(x)
    rms = np.sqrt(np.mean((np.array(found) - expected) ** 2, axis=0)) / np.abs(expected).max(axis=0)
    print(f"{reference.contacts} contacts, rms {rms.max():.1e} of the peak")
    assert reference.contacts > 10
    assert rms.max() < 2e-3


def test_stick_and_slip_are_those_of_solve_ivp() -> None:
    """A heavy rotor pulls a load, by a soft shaft, over a friction that falls with the speed."""
    motor = replace(DEAD, inertia_kg_m2=1.0, coulomb_friction_nm=0.2)
    shaft = Coupling(0.9996, 0.0004, 8.0, 0.0)
    friction = Friction(0.3, 0.5, 0.2, Side.LOAD)
    plant = plant_of(Mechanism(shaft, friction), motor)
    reference = Reference(shaft, 0.2, 0.3, 0.5, way=0)
    plant.spin(1.0, 0.0)
    x, found, expected = np.array([1.0, 0.0, 0.0]), [], []
    for _ in range(3200):
        plant.advance(0.0, 0.0)
        x = reference.advance(x, PERIOD_S, 0.0, 0.0)
        found.append(observe(plant)[1:])
        expected.append(x[1:])
    rms = np.sqrt(np.mean((np.array(found) - expected) ** 2, axis=0)) / np.abs(expected).max(axis=0)
    resting = float(np.mean(np.array(found)[:, 0] == 0.0))
    print(f"{reference.rests} rests, {100 * resting:.0f} % at rest, rms {rms.max():.1e} of the peak")
    assert reference.rests >= 3
    assert resting > 0.2
    assert rms.max() < 2e-3


@pytest.mark.parametrize(("speed_rad_s", "coulomb_nm"), [(2.0, 0.1), (5.0, 0.1), (-2.0, 0.15), (-40.0, 0.15)])
def test_the_steady_map_of_friction(speed_rad_s: float, coulomb_nm: float) -> None:
    """A shaft that coasts slows down by what the curve says at its speed."""
    motor = replace(DEAD, coulomb_friction_nm=0.1, viscous_friction_nm_s=0.002)
    plant = plant_of(Mechanism(friction=Friction(0.25, 3.0, 0.15)), motor)
    plant.spin(speed_rad_s)
    plant.advance(0.0, 0.0)
    middle = 0.5 * (speed_rad_s + plant.speed_rad_s)
    more = {0.1: 0.15, 0.15: 0.15}[coulomb_nm]
    expected = coulomb_nm + more / (1.0 + (middle / 3.0) ** 2) + 0.002 * abs(middle)
    slowed = abs(plant.speed_rad_s - speed_rad_s) / PERIOD_S * motor.inertia_kg_m2
    assert slowed == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("speed_rad_s", [40.0, -40.0])
@pytest.mark.parametrize(("hanging_nm", "load_nm"), [(0.0, 0.6), (0.5, 0.6), (0.5, -0.9)])
def test_a_load_adds_its_share_to_the_friction(speed_rad_s: float, hanging_nm: float, load_nm: float) -> None:
    """Of what the bench and the load's own place ask together; at rest it holds what it can."""
    friction, load = Friction(0.1, 3.0, 0.1, load_share=0.2), PlacedLoad(hanging_nm=hanging_nm)
    motor = replace(DEAD, coulomb_friction_nm=0.1)
    plant = plant_of(Mechanism(friction=friction, load=load), motor)
    plant.advance(0.0, 0.0, load_nm)
    plant.spin(speed_rad_s)
    plant.advance(0.0, 0.0, load_nm)
    asked_nm = hanging_nm + load_nm
    expected = -asked_nm - math.copysign(0.1 + 0.2 * abs(asked_nm), speed_rad_s)
    found = (plant.speed_rad_s - speed_rad_s) / PERIOD_S * motor.inertia_kg_m2
    assert found == pytest.approx(expected, rel=1e-9)


def test_a_gear_that_rubs_by_its_load_holds_a_weight() -> None:
    """With more friction for each N m than that N m pulls."""
    for share, falls in ((1.01, False), (0.99, True)):
        mechanism = Mechanism(friction=Friction(0.0, 3.0, 0.0, load_share=share))
        plant = plant_of(mechanism, replace(DEAD, coulomb_friction_nm=0.0))
        plant.advance(0.0, 0.0, 0.5, periods=1600)
        assert (plant.speed_rad_s != 0.0) is falls


def test_breakaway_holds_the_shaft_and_lets_go_beyond() -> None:
    motor = replace(DEAD, coulomb_friction_nm=0.1)
    plant = plant_of(Mechanism(friction=Friction(0.25, 3.0, 0.1)), motor)
    for load_nm, moves in ((0.249, False), (-0.249, False), (0.251, True)):
        for _ in range(160):
            plant.advance(0.0, 0.0, load_nm)
        assert (plant.speed_rad_s != 0.0) is moves


@pytest.mark.parametrize("by_angle", [False, True])
def test_cogging_is_seen_in_the_spectrum_of_the_speed(by_angle: bool) -> None:
    """The ripple of order n is amplitude / (J n w), as speed over time, its phase a quarter behind."""
    harmonics = (CoggingHarmonic(8, 0.02), CoggingHarmonic(24, 0.05, 0.6))
    angle = np.arange(2880) * math.tau / 2880
    points = tuple(0.02 * np.sin(8 * angle) + 0.05 * np.sin(24 * angle + 0.6)) if by_angle else ()
    mechanism = Mechanism(cogging_points_nm=points) if by_angle else Mechanism(cogging=harmonics)
    plant = plant_of(mechanism)
    speed_rad_s = math.tau * 20.0
    plant.spin(speed_rad_s)
    speeds = []
    for _ in range(16_000):
        plant.advance(0.0, 0.0)
        speeds.append(plant.speed_rad_s)
    lines = np.abs(np.fft.rfft(np.array(speeds) * np.hanning(16_000))) / 4_000
    mean = float(np.mean(speeds))
    for harmonic in harmonics:
        at = round(harmonic.per_turn * mean / math.tau)
        found = lines[at - 2 : at + 3].max()
        assert found == pytest.approx(
            harmonic.torque_nm / (DEAD.inertia_kg_m2 * harmonic.per_turn * mean), rel=0.02
        )
