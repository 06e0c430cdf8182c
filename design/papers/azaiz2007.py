"""[Azaiz2007]: the motor, both controllers, and the drive of Fig. 4 as a continuous reference simulation.

The drive: PID speed loop on e = omega_ref - omega, i_q limited to 20 A, both current controllers with
decoupling by the nominal parameters, inverter of gain 1 without limit (their remark in 3.2). The
derivative acts on the speed, because the paper says nothing about the impulse of a stepped reference;
it is exact, d omega/dt being known from the equation of motion. The integral is not stopped at the limit.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import scipy.integrate

from servobench.design.current.current_design import (
    AxisDesign,
    axis_inductance_h,
    describe,
    design_axis,
    design_figures,
    reduced_design,
    rule_weights,
)
from servobench.design.hinf.mixed_sensitivity import axis_plant, mixed_sensitivity
from servobench.design.hinf.reduction import Method
from servobench.design.hinf.synthesis import gamma_min
from servobench.design.motor import PmsmParameters, Transform
from servobench.design.statespace import Array, StateSpace, balanced, from_zpk

_Value = TypeVar("_Value", float, Array)

MOTOR = PmsmParameters(
    name="Azaiz2007",
    resistance_ohm=0.6,
    inductance_d_h=1.4e-3,
    inductance_q_h=2.8e-3,
    flux_linkage_wb=0.12,
    pole_pairs=4,
    inertia_kg_m2=1.11e-3,
    viscous_friction_nm_s=1.4e-3,
    coulomb_friction_nm=0.0,
    transform=Transform.AMPLITUDE_INVARIANT,
    rated_torque_nm=8.5,
    rated_speed_rad_s=230.0,
    current_max_a=20.0,
    dc_bus_voltage_v=300.0,
)
"""Section 6; P = 4 counts pole pairs. The DC bus is not in the paper and not used here."""

KP, KD, KI = 0.5045, 0.0045, 0.5
"""A per rad/s, A s^2/rad, A/rad: the PID gives i_qr."""
SPEED_RAD_S, LOAD_NM, LOAD_AT_S = 175.0, 3.0, 0.08
DURATION_S = 0.25

VARIATIONS: Mapping[str, tuple[float, float]] = {
    "nominal": (1.0, 1.0),
    "time_constants_plus_50": (1.0, 1.5),
    "time_constants_minus_50": (1.0, 0.5),
    "resistance_plus_50": (1.5, 1.0),
    "resistance_minus_50": (0.5, 1.0),
}
"""Factors on r_s, and on L_d and L_q; the paper varies L/r by 50 % without saying through which."""

PUBLISHED: Mapping[str, Mapping[str, float]] = {
    "q": {
        "gain": 49.70,
        "gain_margin_db": 31.2,
        "gain_margin_rad_s": 2600.0,
        "phase_margin_deg": 83.7,
        "phase_margin_rad_s": 145.0,
        "modulus_margin": 0.92,
        "steady_state_error": 8e-5,
        "rise_time_s": 0.013,
        "settling_time_s": 0.025,
        "overshoot_percent": 0.0,
    },
    "d": {
        "gain": 2.7364,
        "gain_margin_db": 32.3,
        "gain_margin_rad_s": 1290.0,
        "phase_margin_deg": 84.7,
        "phase_margin_rad_s": 61.0,
        "modulus_margin": 0.95,
        "steady_state_error": 6.6e-5,
        "rise_time_s": 0.032,
        "settling_time_s": 0.059,
    },
    "simulation": {"peak_torque_nm": 14.3},
}

_PRINTED: Mapping[str, tuple[float, tuple[float, ...], tuple[float, ...], tuple[float, float]]] = {
    "q": (49.70, (-214.3, -5e4, -2.714e6), (-0.01174, -2.717e6), (4793.0, 6.104e6)),
    "d": (2.7364, (-428.6, -5e4, -1.155e7), (-0.0040, -1.155e7), (2428.0, 1.584e6)),
}
"""Gain, zeros, real poles, and a, b of s^2 + a s + b, of (68) and (70), 1.155e7 for its misprinted rates."""

DISAGREEMENTS = (
    "M_m of K_d: printed 0.95. Neither the synthesis nor the printed K_d (70) on the printed plant has it "
    "(column 'printed K'), while gain and phase margin, times and static error of both agree with the paper.",
    "K_q's gain is 49.7026 with the weights by their rules (crossing 156.75 rad/s, 1e4 at rest), as (71) "
    "says, and 49.7105 with the rounded numbers of (44) and (46).",
    "Peak torque: the current loop needs 13 ms to rise and the speed needs 14 ms, so i_q has left its limit "
    "before it reaches 20 A; the printed 14.3 N m is the limit itself, 14.4 N m, and does not follow.",
    "The peak and the times of Fig. 13 hang on whether L or r varies, which the paper does not say; both "
    "are given.",
)


def printed_controller(axis: str) -> StateSpace:
    """Return (68) or (70) in the printed digits."""
    gain, zeros, poles, (a, b) = _PRINTED[axis]
    return from_zpk(zeros, [*poles, *np.roots([1.0, a, b])], gain)


def printed_figures(axis: str) -> dict[str, Any]:
    """Return the figures of the printed controller on the printed plant, with the weights by their rules."""
    weights = rule_weights(MOTOR, axis)
    plant = axis_plant(MOTOR.resistance_ohm, axis_inductance_h(MOTOR, axis))
    least = gamma_min(mixed_sensitivity(plant, weights))
    return design_figures(describe(plant, weights, printed_controller(axis), least))


def motor_of(variation: str) -> PmsmParameters:
    """Return the motor of a named variation."""
    r, L = VARIATIONS[variation]
    return replace(
        MOTOR,
        resistance_ohm=MOTOR.resistance_ohm * r,
        inductance_d_h=MOTOR.inductance_d_h * L,
        inductance_q_h=MOTOR.inductance_q_h * L,
    )


def paper_design(axis: str) -> tuple[AxisDesign, AxisDesign]:
    """Return K_q or K_d at gamma = 1 with the weights by their rules, and its third-order form (71), (72)."""
    full = design_axis(MOTOR, axis, rule_weights(MOTOR, axis), 1.0)
    return full, reduced_design(full, 3, Method.PAPER)


@dataclass(frozen=True, slots=True, eq=False)
class DriveRun:
    """Fig. 12 or 13: (k,) each, at equal steps."""

    time_s: Array
    current_d_a: Array
    current_q_a: Array
    torque_nm: Array
    speed_rad_s: Array


def simulate_drive(motor: PmsmParameters, K_d: StateSpace, K_q: StateSpace, step_s: float = 1e-5) -> DriveRun:
    """Simulate the drive of Fig. 4 with ``motor`` behind loops that decouple with the nominal inductances."""
    Kd, Kq = balanced(K_d), balanced(K_q)
    n_d = Kd.order
    total = 4 + n_d + Kq.order

    def slopes(t: float, x: Array) -> Array:
        i_d, i_q, speed, integral = x[:4]
        electrical = motor.pole_pairs * speed
        torque = _torque(motor, i_d, i_q)
        load = LOAD_NM if t >= LOAD_AT_S else 0.0
        acceleration = (torque - motor.viscous_friction_nm_s * speed - load) / motor.inertia_kg_m2
        error = SPEED_RAD_S - speed
        reference_a = min(max(KP * error + KI * integral - KD * acceleration, -20.0), 20.0)
        e_d, e_q = -i_d, reference_a - i_q
        x_d, x_q = x[4 : 4 + n_d], x[4 + n_d :]
        v_d = float((Kd.C @ x_d)[0]) + Kd.D[0, 0] * e_d - electrical * MOTOR.inductance_q_h * i_q
        v_q = float((Kq.C @ x_q)[0]) + Kq.D[0, 0] * e_q
        v_q += electrical * (MOTOR.inductance_d_h * i_d + MOTOR.flux_linkage_wb)
        out = np.empty(total)
        r, Ld, Lq = motor.resistance_ohm, motor.inductance_d_h, motor.inductance_q_h
        out[0] = (v_d - r * i_d + electrical * Lq * i_q) / Ld
        out[1] = (v_q - r * i_q - electrical * (Ld * i_d + motor.flux_linkage_wb)) / Lq
        out[2], out[3] = acceleration, error
        out[4 : 4 + n_d] = Kd.A @ x_d + Kd.B[:, 0] * e_d
        out[4 + n_d :] = Kq.A @ x_q + Kq.B[:, 0] * e_q
        return out

    time_s = np.arange(0.0, DURATION_S + step_s / 2, step_s)
    before, after = time_s[time_s < LOAD_AT_S - step_s / 2], time_s[time_s >= LOAD_AT_S - step_s / 2]
    states, start = [], np.zeros(total)
    for low, high, grid in ((0.0, LOAD_AT_S, before), (LOAD_AT_S, DURATION_S, after)):
        end = np.nextafter(high, 0.0) if high == LOAD_AT_S else high
        solution = scipy.integrate.solve_ivp(
            slopes,
            (low, end),
            start,
            method="LSODA",
            t_eval=np.unique(np.append(np.clip(grid, low, end), end)),
            rtol=1e-8,
            atol=1e-9,
            max_step=2e-4,
        )
        states.append(solution.y[:, : len(grid)])
        start = solution.y[:, -1]
    y = np.hstack(states)
    return DriveRun(time_s, y[0], y[1], _torque(motor, y[0], y[1]), y[2])


def _torque(motor: PmsmParameters, i_d: _Value, i_q: _Value) -> _Value:
    flux = motor.flux_linkage_wb + (motor.inductance_d_h - motor.inductance_q_h) * i_d
    return motor.torque_factor * motor.pole_pairs * flux * i_q


def run_figures(run: DriveRun) -> dict[str, float]:
    """Return the figures of one run: rise 10 to 90 % and settling within 2 % of the step, before the load
    comes."""
    before = run.time_s < LOAD_AT_S
    speed, time_s = run.speed_rad_s[before], run.time_s[before]
    peak = int(np.argmax(run.torque_nm[before]))
    return {
        "peak_torque_nm": float(run.torque_nm[peak]),
        "peak_torque_time_s": float(run.time_s[peak]),
        "rise_time_s": _first_above(time_s, speed, 0.9) - _first_above(time_s, speed, 0.1),
        "settling_time_s": _settled(time_s, speed),
        "speed_max_rad_s": float(run.speed_rad_s.max()),
        "speed_min_after_step_rad_s": float(run.speed_rad_s[~before].min()),
        "id_max_a": float(np.abs(run.current_d_a).max()),
    }


def _first_above(time_s: Array, speed: Array, fraction: float) -> float:
    above = np.flatnonzero(speed >= fraction * SPEED_RAD_S)
    return float(time_s[above[0]]) if len(above) else math.inf


def _settled(time_s: Array, speed: Array) -> float:
    outside = np.flatnonzero(np.abs(speed - SPEED_RAD_S) > 0.02 * SPEED_RAD_S)
    last = int(outside[-1])
    return float(time_s[last + 1]) if last + 1 < len(time_s) else math.inf


def reproduce() -> tuple[dict[str, Any], dict[str, tuple[AxisDesign, AxisDesign]], dict[str, DriveRun]]:
    """Return all figures in the keys of ``--json``, the designs by axis, and the runs by variation."""
    designs = {axis: paper_design(axis) for axis in ("q", "d")}
    figures: dict[str, Any] = {axis: design_figures(*pair) for axis, pair in designs.items()}
    K_d, K_q = designs["d"][0].controller, designs["q"][0].controller
    runs = {name: simulate_drive(motor_of(name), K_d, K_q) for name in VARIATIONS}
    figures["simulation"] = {name: run_figures(run) for name, run in runs.items()}
    return figures, designs, runs
