"""A load by its place, against scipy: energy, solve_ivp with events, an interpolator, closed forms of a
contact. The motor is dead: mechanics are all there is."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import brentq

from servobench import run
from servobench.design.mechanism import Arm, Coupling, EndStops, LoadMap, Mechanism, PlacedLoad
from servobench.hil.verdict.verdict import LimitResult
from tests.draws import few_of
from tests.motors import LING
from tests.plant import Plant
from tests.scenario.processes import EXAMPLES

PERIOD_S = 1.0 / 16_000
FloatArray = NDArray[np.float64]
DEAD = replace(LING, flux_linkage_wb=1e-12, viscous_friction_nm_s=0.0)
J = DEAD.inertia_kg_m2
SHAFT = Coupling(0.3 * J, 0.7 * J, 40.0, 0.0)


def plant_of(load: PlacedLoad, coupling: Coupling | None = None, coulomb_nm: float = 0.0) -> Plant:
    return Plant(
        replace(DEAD, coulomb_friction_nm=coulomb_nm, mechanism=Mechanism(coupling=coupling, load=load))
    )


def rotor_rad(plant: Plant) -> float:
    return plant.turns * math.tau + plant.angle_rad


def load_rad(plant: Plant) -> float:
    return rotor_rad(plant) - plant.twist_rad


def course(plant: Plant, periods: int, load_nm: float = 0.0) -> FloatArray:
    """The load's angle and speed at the end of each period."""
    found = []
    for _ in range(periods):
        plant.advance(0.0, 0.0, load_nm)
        found.append((load_rad(plant), plant.load_speed_rad_s))
    return np.array(found)


def rms_of_peak(found: FloatArray, expected: FloatArray) -> float:
    return float((np.sqrt(np.mean((found - expected) ** 2, axis=0)) / np.abs(expected).max(axis=0)).max())


# ---- weights -------------------------------------------------------------------------------------------


def test_a_hanging_weight_falls_freely() -> None:
    plant = plant_of(PlacedLoad(hanging_nm=0.3))
    plant.advance(0.0, 0.0, 0.1, periods=4800)
    assert plant.speed_rad_s == pytest.approx(-0.4 / J * 0.3, rel=1e-12)
    assert rotor_rad(plant) == pytest.approx(-0.5 * 0.4 / J * 0.3**2, rel=1e-11)


@pytest.mark.parametrize("coupling", [None, SHAFT])
@pytest.mark.parametrize(("ratio", "phase_rad", "speed_rad_s"), [(1.0, 2.0, 0.0), (20.0, 0.5, -80.0)])
def test_an_arm_keeps_its_energy(
    coupling: Coupling | None, ratio: float, phase_rad: float, speed_rad_s: float
) -> None:
    """Motion, height and twist, over a second: of the largest motion."""
    plant = plant_of(PlacedLoad(arm=Arm(0.8, ratio, phase_rad)), coupling)
    plant.spin(speed_rad_s)

    def energy() -> tuple[float, float]:
        height_j = -0.8 * ratio * math.cos(load_rad(plant) / ratio + phase_rad)
        if coupling is None:
            moving_j = 0.5 * J * plant.speed_rad_s**2
            return moving_j, moving_j + height_j
        moving_j = 0.5 * coupling.motor_kg_m2 * plant.speed_rad_s**2
        moving_j += 0.5 * coupling.load_kg_m2 * plant.load_speed_rad_s**2
        return moving_j, moving_j + height_j + 0.5 * coupling.stiffness_nm_rad * plant.twist_rad**2

    start, most, worst = energy()[1], 0.0, 0.0
    for _ in range(16_000):
        plant.advance(0.0, 0.0)
        moving_j, all_j = energy()
        most, worst = max(most, moving_j), max(worst, abs(all_j - start))
    print(f"{worst / most:.1e} of {most:.3g} J")
    assert worst < 1e-6 * most


def test_an_arm_swings_as_solve_ivp_has_it() -> None:
    plant = plant_of(PlacedLoad(arm=Arm(0.5, 3.0, 1.2)), coulomb_nm=0.0)
    solution = solve_ivp(
        lambda _, x: (x[1], -0.5 * math.sin(x[0] / 3.0 + 1.2) / J),
        (0.0, 0.5),
        (0.0, 0.0),
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
        t_eval=np.arange(1, 8001) * PERIOD_S,
    )
    rms = rms_of_peak(course(plant, 8000), solution.y.T)
    print(f"rms {rms:.1e} of the peak")
    assert rms < 1e-8


# ---- table ---------------------------------------------------------------------------------------------

TURNS = (-0.4, 0.1, 0.35, 1.2)
SPEEDS_RAD_S = (-60.0, -5.0, 0.0, 20.0, 90.0)


def drawn_table(seed: int, repeats: bool) -> LoadMap:
    torques = np.random.default_rng(seed).uniform(-0.5, 0.5, (len(TURNS), len(SPEEDS_RAD_S)))
    if repeats:
        torques[-1] = torques[0]
    return LoadMap(TURNS, SPEEDS_RAD_S, tuple(map(tuple, torques.tolist())), repeats)


@pytest.mark.parametrize("repeats", [False, True])
@pytest.mark.parametrize("seed", few_of(range(4), 2))
def test_a_table_is_scipys_interpolator(seed: int, repeats: bool) -> None:
    """The acceleration of a first step from drawn places and speeds, inside of the table and beyond it."""
    table = drawn_table(seed, repeats)
    torque = RegularGridInterpolator((table.turns, table.speeds_rad_s), np.array(table.torques_nm))
    draw = np.random.default_rng(100 + seed)
    span = TURNS[-1] - TURNS[0]
    for turns, speed in zip(draw.uniform(-3.0, 4.0, 200), draw.uniform(-160.0, 160.0, 200), strict=True):
        plant = Plant(replace(DEAD, mechanism=Mechanism(load=PlacedLoad(table=table))), 1e-7)
        plant.set_angle(float(turns))
        plant.spin(float(speed))
        plant.advance(0.0, 0.0)
        place = (
            TURNS[0] + (turns - TURNS[0]) % span if repeats else float(np.clip(turns, TURNS[0], TURNS[-1]))
        )
        expected = torque((place, float(np.clip(speed, SPEEDS_RAD_S[0], SPEEDS_RAD_S[-1])))).item()
        assert -(plant.speed_rad_s - speed) / 1e-7 * J == pytest.approx(expected, abs=2e-5)


def test_a_shaft_in_a_table_runs_as_solve_ivp_has_it() -> None:
    table = drawn_table(7, repeats=True)
    torque = RegularGridInterpolator((table.turns, table.speeds_rad_s), np.array(table.torques_nm))

    def slopes(_: float, x: FloatArray) -> tuple[float, float]:
        place = TURNS[0] + (x[0] / math.tau - TURNS[0]) % (TURNS[-1] - TURNS[0])
        return x[1], -torque((place, np.clip(x[1], SPEEDS_RAD_S[0], SPEEDS_RAD_S[-1]))).item() / J

    plant = plant_of(PlacedLoad(table=table))
    plant.spin(30.0)
    at_s = np.arange(1, 1601) * PERIOD_S
    solution = solve_ivp(slopes, (0.0, 0.1), (0.0, 30.0), rtol=1e-9, atol=1e-9, max_step=2e-4, t_eval=at_s)
    rms = rms_of_peak(course(plant, 1600), solution.y.T)
    print(f"rms {rms:.1e} of the peak")
    assert rms < 1e-5


# ---- end stops -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("damping_ratio", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("speed_rad_s", [3.0, 47.0, -150.0])
def test_an_end_stop_is_touched_and_left_when_it_is(speed_rad_s: float, damping_ratio: float) -> None:
    """Both instants, and the speed behind it, of the closed form of one contact. A step is cut within 16 ns
    of the touch, and so much later the damper begins."""
    stops = EndStops(-0.3, 0.3, 90.0, damping_ratio)
    plant = plant_of(PlacedLoad(stops=stops))
    plant.spin(speed_rad_s)
    way, bound = math.copysign(1.0, speed_rad_s), 0.3 * math.tau
    omega = math.sqrt(stops.stiffness_nm_rad / J)
    decay, swing = damping_ratio * omega, omega * math.sqrt(1.0 - damping_ratio**2)

    def pressed(t: float) -> float:
        return abs(speed_rad_s) / swing * math.exp(-decay * t) * math.sin(swing * t)

    def speed(t: float) -> float:
        turning = math.cos(swing * t) - decay / swing * math.sin(swing * t)
        return abs(speed_rad_s) * math.exp(-decay * t) * turning

    touched_s = bound / abs(speed_rad_s)
    contact_s = brentq(
        lambda t: omega**2 * pressed(t) + 2.0 * decay * speed(t),
        0.5 / omega,
        1.1 * math.pi / swing,
        xtol=1e-15,
    )
    plant.advance(0.0, 0.0, periods=math.floor(touched_s / PERIOD_S) + 1)
    found_s = plant.time_s(PERIOD_S) - brentq(
        lambda t: pressed(t) - (way * rotor_rad(plant) - bound), 0.0, 1.5 * PERIOD_S, xtol=1e-15
    )
    assert plant.stop_hits == 1
    assert plant.stop_hit_rad_s == pytest.approx(speed_rad_s, rel=1e-9)
    print(f"touched {abs(found_s - touched_s) * 1e9:.3f} ns off")
    assert found_s == pytest.approx(touched_s, abs=2e-8)
    plant.advance(0.0, 0.0, periods=math.floor(contact_s / PERIOD_S) + 2)
    back = way * speed(contact_s)
    print(f"speed {abs(plant.speed_rad_s / back - 1.0):.1e} off")
    assert plant.speed_rad_s == pytest.approx(back, rel=2.0 * decay * 1.6e-8 + 1e-8)
    place = way * (bound + pressed(contact_s))
    left_s = plant.time_s(PERIOD_S) - (rotor_rad(plant) - place) / back
    print(f"left {abs(left_s - touched_s - contact_s) * 1e9:.3f} ns off")
    assert left_s == pytest.approx(touched_s + contact_s, abs=1e-6)


@dataclass
class Bouncing:
    """A load between two stops by solve_ivp: one integration for each phase."""

    stops: EndStops
    coupling: Coupling | None
    pull_nm: Callable[[float], float]
    at: int = 0
    touches: int = 0

    def push(self, angle: float, speed: float) -> float:
        if not self.at:
            return 0.0
        ends = self.stops.negative_turns, self.stops.positive_turns
        end = ends[self.at > 0]
        assert end is not None
        inertia = J if self.coupling is None else self.coupling.load_kg_m2
        damping = self.stops.damping_nm_s(inertia)
        return float(self.stops.stiffness_nm_rad * (angle - end * math.tau) + damping * speed)

    def slopes(self, _: float, x: FloatArray) -> list[float]:
        """x: the load's angle and speed, the rotor's."""
        outside = -self.push(x[0], x[1]) - self.pull_nm(x[0])
        if self.coupling is None:
            return [x[1], outside / J, x[1], outside / J]
        passed = self.coupling.stiffness_nm_rad * (x[2] - x[0])
        passed += self.coupling.damping_nm_s * (x[3] - x[1])
        return [
            x[1],
            (passed + outside) / self.coupling.load_kg_m2,
            x[3],
            -passed / self.coupling.motor_kg_m2,
        ]

    def events(self) -> list[Callable[[float, FloatArray], float]]:
        low, high = self.stops.negative_turns, self.stops.positive_turns
        assert low is not None
        assert high is not None
        found: list[Callable[[float, FloatArray], float]]
        if self.at:
            found = [lambda _, x: self.at * self.push(x[0], x[1])]
        else:
            found = [lambda _, x: high * math.tau - x[0], lambda _, x: x[0] - low * math.tau]
        for event in found:
            event.terminal, event.direction = True, -1  # type: ignore[attr-defined]
        return found

    def advance(self, x: FloatArray, duration_s: float) -> FloatArray:
        left = duration_s
        while left > 0.0:
            events = self.events()
            solution = solve_ivp(
                self.slopes, (0.0, left), x, method="DOP853", rtol=1e-11, atol=1e-12, events=events
            )
            x, left = solution.y[:, -1].copy(), left - solution.t[-1]
            for side, times in zip((1, -1), solution.t_events, strict=False):
                if len(times):
                    self.at = 0 if self.at else side
                    self.touches += self.at != 0
        return x


@pytest.mark.parametrize("damping_ratio", [0.02, 0.3])
@pytest.mark.parametrize("coupling", [None, replace(SHAFT, damping_ratio=0.02)])
def test_a_load_bounces_between_its_stops_as_solve_ivp_has_it(
    coupling: Coupling | None, damping_ratio: float
) -> None:
    """An arm in a stretch of 0.3 turns, pushed to and fro."""
    stops = EndStops(-0.1, 0.2, 90.0, damping_ratio)
    arm = Arm(0.4, 1.0, 0.3)
    plant = plant_of(PlacedLoad(arm=arm, stops=stops), coupling)
    reference = Bouncing(stops, coupling, lambda angle: 0.4 * math.sin(angle + 0.3))
    plant.spin(160.0)
    x = np.array([0.0, 160.0, 0.0, 160.0])
    found, expected = course(plant, 4800), []
    for _ in range(4800):
        x = reference.advance(x, PERIOD_S)
        expected.append(x[:2])
    rms = rms_of_peak(found, np.array(expected))
    print(f"{reference.touches} touches, rms {rms:.1e} of the peak")
    assert reference.touches >= 4
    assert plant.stop_hits == reference.touches
    assert rms < 2e-3


def test_a_hanging_load_rests_on_its_stop() -> None:
    """It sinks in by its torque over the stiffness; friction holds a hair above or below."""
    plant = plant_of(PlacedLoad(hanging_nm=0.5, stops=EndStops(-0.05, None, 50.0, 0.6)), coulomb_nm=0.01)
    plant.advance(0.0, 0.0, periods=16_000)
    assert plant.speed_rad_s == 0.0
    assert rotor_rad(plant) == pytest.approx(-0.05 * math.tau - 0.01, abs=0.01 / 50.0)


def test_a_load_that_nothing_asks_for_is_a_rigid_shaft() -> None:
    rigid, placed = Plant(DEAD), plant_of(PlacedLoad())
    for plant in (rigid, placed):
        plant.spin(30.0)
        plant.advance(0.0, 0.0, 0.2, periods=500)
    assert placed.speed_rad_s == pytest.approx(rigid.speed_rad_s, rel=1e-12)


# ---- on a bench ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bench", "load", "broken"),
    [
        ("ling2012", {"hanging_nm": 1.0}, set()),
        ("ling2012", {"arm": {"torque_nm": 0.5}}, {"speed_error_rms_rad_s_max", "torque_rms_nm_max"}),
        ("cabinet", {"hanging_nm": 1.0}, {"speed_error_peak_percent_max"}),
        ("position_csp", {"hanging_nm": 0.3}, set()),
        ("position_csp", {"arm": {"torque_nm": 0.5}}, {"position_error_peak_rad_max"}),
    ],
)
def test_a_bench_passes_or_fails_by_its_load(bench: str, load: dict[str, Any], broken: set[str]) -> None:
    """All of them pass without one, tests/scenario has it."""
    found = run(EXAMPLES / f"{bench}.toml", {"drive.axis1.motor.load": load}).verdict
    assert {each.metric for each in found.limits if each.result is LimitResult.BROKEN} == broken
    assert found.passed is not bool(broken)


def test_an_end_stop_in_the_way_is_hit_once_and_leant_on() -> None:
    stops = {"end_stops": {"positive_rad": 6.6, "stiffness_nm_rad": 100.0}}
    found = run(EXAMPLES / "position_csp.toml", {"drive.axis1.motor.load": stops, "bench.duration_s": 1.2})
    assert not found.verdict.passed
    assert 6.6 < max(found.column("position_rad")) < 6.6 + 0.1
