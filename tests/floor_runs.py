"""Controllers on whole runs of a simulated drive under a load step: designs, and ratios to the floor."""

import copy
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from servobench.design.delay.delay_loop import peak_floor_rad_s, speed_model
from servobench.design.motor import PmsmParameters
from servobench.design.speed.hinf_loop import Conditioned
from servobench.design.speed.predictor_design import PredictorRequest
from servobench.design.speed.speed_design import least_gain
from servobench.design.speed.speed_pid import first_order_current_loop, pid_by_rule
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.studies.speed.dynamic import (
    PredictorResult,
    design_speed_hinf,
    design_speed_predictor,
    request_of,
)
from servobench.hil.studies.speed.fused import design_speed_fused, fused_request
from tests.shaft_run import ShaftRun, run_watched

PERIOD_S = 1e-3
CURRENT_HZ = 800.0
DEAD_TIME_S = 125e-6
"""Two inner ticks from the end of a SYNC to the first voltage of its command."""
SHARE = 0.3
"""Of the rated torque."""
LOAD_AT_S = 1.45
"""Since power-on; the run begins at 0.6 s."""
LOST = 5


@dataclass(frozen=True, slots=True)
class Case:
    """A motor, as tables of a motor file, behind a delay."""

    name: str
    motor: dict[str, Any]
    delay_s: float
    """tau: from a sample to its command's instant; whole periods."""
    counts: int = 65_536

    @property
    def parameters(self) -> PmsmParameters:
        """Of the motor."""
        return self.config({"kind": "pid", "proportional_nm_s_rad": 0.0}).drive["axis1"].motor.parameters

    @property
    def load_nm(self) -> float:
        """The step."""
        return SHARE * float(self.motor["rating"]["torque_nm"])

    def floor_rad_s(self, inertia: float = 1.0, lost: int = 0) -> float:
        """Of the step."""
        motor = copy.deepcopy(self.motor)
        motor["mechanics"]["inertia_kg_m2"] *= inertia
        own = Case(self.name, motor, self.delay_s)
        return self.load_nm * peak_floor_rad_s(
            own.parameters, (1 + lost) * PERIOD_S + self.delay_s + DEAD_TIME_S
        )

    def config(
        self, controller: dict[str, Any], inertia: float = 1.0, lost_from_s: float | None = None
    ) -> BenchConfig:
        """The bench; ``lost_from_s``: since the run began, from when on readings are lost."""
        motor = copy.deepcopy(self.motor)
        motor["mechanics"]["inertia_kg_m2"] *= inertia
        speed_rpm = 0.5 * float(motor["rating"]["speed_rpm"])
        faults: dict[str, list[dict[str, Any]]] = {}
        readings = {"direction": "drive_to_host", "frames": ["pdo"]}
        if self.delay_s > PERIOD_S:
            late_us = round(1e6 * (self.delay_s - PERIOD_S))
            faults["delay"] = [{**readings, "delay_us": late_us}]
        if lost_from_s is not None:
            until_s = lost_from_s + LOST * PERIOD_S
            lost = {**readings, "probability": 1.0, "from_s": lost_from_s, "until_s": until_s}
            faults["loss"] = [lost]
        tables: dict[str, Any] = {
            "bench": {"name": "control", "duration_s": 1.05 + 20.0 * self.delay_s, "seed": 1},
            "loop": {
                "period_us": round(1e6 * PERIOD_S),
                "actuation": "on_sync",
                "deadline_us": 40_000,
                "horizon_periods": 60,
            },
            "drive": {
                "axis1": {
                    "node": 1,
                    "motor": motor,
                    "simulation": {"encoder_counts_per_revolution": self.counts},
                    "limits": {
                        "speed_max_rpm": 3.0 * speed_rpm,
                        "torque_max_nm": 1.5 * float(motor["rating"]["torque_nm"]),
                    },
                    "controller": controller,
                }
            },
            "reference": {"axis1": [{"at_s": 0.0, "kind": "ramp", "speed_rpm": speed_rpm, "over_s": 0.1}]},
        }
        return bench_from(tables | ({"faults": faults} if faults else {}), self.name, Path())


def request(case: Case) -> PredictorRequest:
    """What the designs go by."""
    motor = case.parameters
    noise_nm = 0.05 * motor.rated_torque_nm
    return request_of(
        motor, CURRENT_HZ, PERIOD_S, case.delay_s, case.load_nm, noise_nm, encoder_counts=case.counts
    )


def predictor(case: Case) -> PredictorResult:
    """Its design; its file would refuse the motors that it is tried on, so it names none."""
    return design_speed_predictor(request(case), 0)


def table_of(found: PredictorResult) -> dict[str, Any]:
    """[controller] without ``made_for``: it also runs on another inertia."""
    return found.controller().model_dump(mode="json", exclude={"made_for", "figures"})


def fused(case: Case) -> dict[str, Any]:
    """The predictor on count and speed; its file, too, would refuse other motors."""
    return (
        design_speed_fused(fused_request(request(case), case.counts), 0)
        .controller()
        .model_dump(mode="json", exclude={"made_for", "figures"})
    )


def hinf(case: Case) -> dict[str, Any]:
    """H-infinity output feedback for the same drive; its file, too, would refuse other motors."""
    return (
        design_speed_hinf(request(case), 0)
        .controller()
        .model_dump(mode="json", exclude={"made_for", "figures"})
    )


def observing(case: Case) -> dict[str, Any]:
    """PI with a load-torque observer, whose commands are as late as those that act, in the form of ``hinf``.

    w^+ = w^ + h/J (u_acting - T^) + l_1 (w - w^)     T^+ = T^ - l_2 (w - w^)     u = T^ - k w^

    k, l_1, l_2 by the criterion of H-infinity: peak, inertia +-30 %, delay margin, torque noise.
    """
    motor = case.parameters
    made = design_speed_hinf(request(case), 0)
    lever, around_s = PERIOD_S / motor.inertia_kg_m2, PERIOD_S + case.delay_s
    late = round(case.delay_s / PERIOD_S)

    def controller(point: NDArray[np.float64]) -> Conditioned:
        gain, pole, load_pole = np.exp(point)
        first, second = math.exp(-pole * PERIOD_S / around_s), math.exp(-load_pole * PERIOD_S / around_s)
        l_1, l_2 = 2.0 - first - second, (1.0 - first) * (1.0 - second) / lever
        state = np.eye(2 + late, k=-1)
        state[:3] = 0.0
        state[:2, :2], state[0, -1] = [[1.0 - l_1, -lever], [l_2, 1.0]], lever
        k = gain * motor.inertia_kg_m2 / around_s
        of_error, out = np.zeros(2 + late), np.zeros(2 + late)
        of_error[:2], out[:2] = [-l_1, l_2], [-k, 1.0]
        return Conditioned(state, of_error, np.eye(2 + late)[2], out, 0.0, PERIOD_S)

    def cost(point: NDArray[np.float64]) -> float:
        found = replace(made.design, controller=controller(point))
        return found.cost if found.loop().spectral_radius() < 1.0 else 1e3

    starts = [np.log([k, p, q]) for k in (0.1, 0.3, 0.6) for p in (0.5, 1.5, 4.0) for q in (0.2, 0.8)]
    best = scipy.optimize.minimize(
        cost, min(starts, key=cost), method="Nelder-Mead", options={"maxfev": 300, "xatol": 1e-2}
    )
    c = controller(best.x)
    matrices = {name: getattr(c, name).tolist() for name in ("A", "B", "L", "C")}
    told = made.controller().model_dump(mode="json", exclude={"made_for", "figures"})
    return told | matrices | {"D": c.D}


def pid(case: Case) -> dict[str, Any]:
    """By the rule of ``hil design pid``."""
    motor, rate = case.parameters, math.tau * CURRENT_HZ
    gains = pid_by_rule(motor, first_order_current_loop(rate), rate, PERIOD_S, case.delay_s)
    return {
        "kind": "pid",
        "proportional_nm_s_rad": gains.proportional_nm_s_rad,
        "integral_nm_rad": gains.integral_nm_rad,
        "derivative_nm_s2_rad": gains.derivative_nm_s2_rad,
        "derivative_filter_s": gains.derivative_filter_s,
        "feedforward_nm_s_rad": motor.viscous_friction_nm_s,
    }


def static(case: Case) -> dict[str, Any]:
    """The least gain for the constant delay, with integral."""
    model = speed_model(case.parameters, True, CURRENT_HZ)
    return {"kind": "state_feedback", "gain": least_gain(model, PERIOD_S + case.delay_s).K.tolist()}


@dataclass(frozen=True, slots=True)
class Found:
    """Ratios of one controller, and what it costs."""

    median: float
    worst: float
    inertia_70: float
    inertia_130: float
    lost: float
    noise_nm: float
    steady_rad_s: float


def peaks(case: Case, controller: dict[str, Any], phases: int, inertia: float = 1.0) -> list[ShaftRun]:
    """A run for each instant of the load step."""
    config = case.config(controller, inertia)
    return [
        run_watched(config, LOAD_AT_S + PERIOD_S * phase / phases, case.load_nm) for phase in range(phases)
    ]


def measure(case: Case, controller: dict[str, Any], phases: int) -> Found:
    """All figures of a controller."""
    within_s = 0.15

    def ratios(runs: list[ShaftRun], inertia: float = 1.0) -> list[float]:
        return [run.peak_rad_s(within_s) / case.floor_rad_s(inertia) for run in runs]

    own = peaks(case, controller, phases)
    less, more = (max(ratios(peaks(case, controller, 3, share), share)) for share in (0.7, 1.3))
    steady = own[0].rows["velocity_rad_s"][-100:]
    wanted_rad_s = 0.5 * float(case.motor["rating"]["speed_rpm"]) * RAD_S_PER_RPM
    return Found(
        float(np.median(ratios(own))),
        max(ratios(own)),
        less,
        more,
        lost_ratio(case, controller, own[0], within_s),
        float(np.std(own[0].commands_nm(LOAD_AT_S - 0.3, LOAD_AT_S))),
        float(np.mean(steady) - wanted_rad_s),
    )


def lost_ratio(case: Case, controller: dict[str, Any], own: ShaftRun, within_s: float) -> float:
    """The step comes right behind a sample, and the next five are lost."""
    sampled_s = own.rows["sampled_at"] * 1e-9
    began_s = own.rows["due_at"][0] * 1e-9
    last_s = float(sampled_s[sampled_s < LOAD_AT_S].max())
    config = case.config(controller, lost_from_s=last_s + 0.5 * PERIOD_S - began_s)
    run = run_watched(config, last_s + 1e-5, case.load_nm)
    return run.peak_rad_s(within_s) / case.floor_rad_s(lost=LOST)
