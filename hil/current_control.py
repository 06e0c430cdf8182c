"""``hil design current``: from a motor and weights to a controller file, with every figure on the way."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from design.current_design import (
    AxisDesign,
    describe,
    design_axis,
    design_figures,
    reduced_design,
    roots,
    rule_weights,
)
from design.current_loop import direct_design, lowest_rate_hz, sampled_figures, tustin
from design.dq_loop import nominal_decoupling, spectral_radius
from design.errors import DesignError
from design.fixed_structure import Structure, tune
from design.hinf import gamma_min
from design.mixed_sensitivity import axis_plant, mixed_sensitivity
from design.motor import PmsmParameters
from design.reduction import Method
from design.robustness import axis_robustness
from design.statespace import StateSpace, zpk
from design.weights import Weights
from drivers.errors import BadInput
from hil.configuration.toml_text import toml_text

GAMMA = 1.0
"""The demand (40), if nothing else is asked for."""


@dataclass(frozen=True, slots=True)
class CurrentRequest:
    """What was asked for."""

    motor: PmsmParameters
    axis: str
    weights: Weights | None = None
    gamma: float | None = None
    gamma_factor: float | None = None
    structure: str = "full"
    order: int | None = None
    method: Method = Method.TRUNCATE
    rate_hz: float | None = None
    delay_samples: int = 1
    direct: bool = False
    modulus_margin: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CurrentResult:
    """What came of it: the designs, the controller to run, and the figures for ``--json``."""

    full: AxisDesign
    chosen: AxisDesign
    sampled: StateSpace | None
    figures: dict[str, Any]


def design_current(request: CurrentRequest) -> CurrentResult:
    """Synthesis, reduction, discretisation and the figures of all. Raises DesignError and BadInput."""
    motor, axis = request.motor, request.axis
    weights = request.weights or rule_weights(motor, axis)
    inductance = motor.inductance_d_h if axis == "d" else motor.inductance_q_h
    plant = axis_plant(motor.resistance_ohm, inductance)
    least = gamma_min(mixed_sensitivity(plant, weights))
    full = design_axis(motor, axis, weights, _gamma(request, least))
    chosen = full
    if request.structure != "full":
        tuned = tune(plant, weights, Structure(request.structure), full.margins.phase_margin_rad_s)
        chosen = describe(plant, weights, tuned.controller, least)
    reduced = None
    if request.order is not None:
        try:
            reduced = reduced_design(chosen, request.order, request.method)
        except ValueError as error:
            raise BadInput("--reduce", "", request.order, str(error)) from None
    figures = design_figures(chosen, reduced)
    figures["axis"], figures["structure"] = axis, request.structure
    figures["gamma_full_order"] = full.closed_loop_norm
    chosen = reduced or chosen
    figures["robust"] = _robust(motor.resistance_ohm, inductance, chosen, weights)
    sampled = None
    if request.rate_hz is not None:
        sampled, figures["sampled"] = _sampled(request, plant, chosen, weights)
    return CurrentResult(full, chosen, sampled, figures)


def _gamma(request: CurrentRequest, least: float) -> float:
    if request.gamma is not None:
        return request.gamma
    return GAMMA if request.gamma_factor is None else request.gamma_factor * least


def _robust(
    resistance_ohm: float, inductance_h: float, design: AxisDesign, weights: Weights
) -> dict[str, Any]:
    found = axis_robustness(resistance_ohm, inductance_h, design.controller, weights)
    bound = found.weighted_sensitivity_bound
    return {
        "stable": found.stable,
        "real_mu_peak": found.real_mu_peak,
        "worst_modulus_margin": found.worst_modulus_margin,
        "worst_weighted_sensitivity": found.worst_weighted_sensitivity if found.stable else None,
        "weighted_sensitivity_bound": bound if np.isfinite(bound) else None,
        "worst_resistance_ohm": found.worst_resistance_ohm,
        "worst_inductance_h": found.worst_inductance_h,
    }


def _sampled(
    request: CurrentRequest, plant: StateSpace, design: AxisDesign, weights: Weights
) -> tuple[StateSpace, dict[str, Any]]:
    assert request.rate_hz is not None
    crossover = design.margins.phase_margin_rad_s
    try:
        if request.direct:
            gamma = _gamma(request, design.gamma_min)
            controller, _ = direct_design(plant, weights, gamma, request.rate_hz, request.delay_samples)
        else:
            controller = tustin(design.controller, request.rate_hz, crossover)
    except ValueError as error:
        raise BadInput("--sample-rate-hz", "", request.rate_hz, str(error)) from None
    found = sampled_figures(plant, controller, request.delay_samples)
    figures: dict[str, Any] = {
        "rate_hz": request.rate_hz,
        "delay_samples": request.delay_samples,
        "method": "direct" if request.direct else "tustin",
        "phase_margin_deg": _finite(found.margins.phase_margin_deg),
        "gain_margin_db": _finite(found.margins.gain_margin_db),
        "modulus_margin": found.margins.modulus_margin,
        "spectral_radius": found.spectral_radius,
    }
    if found.spectral_radius >= 1.0:
        raise BadInput(
            "--sample-rate-hz",
            "",
            request.rate_hz,
            f"a rate at which the loop is stable; its spectral radius is {found.spectral_radius:.4f}",
            "sample faster, shorten the delay, or lower the crossing of w1",
        )
    wanted = request.modulus_margin or 0.9 * design.margins.modulus_margin
    figures["lowest_rate"] = {
        "modulus_margin": wanted,
        "rate_hz": lowest_rate_hz(plant, design.controller, crossover, wanted, request.delay_samples),
    }
    figures["coupled"] = _coupled(request, controller)
    return controller, figures


def _coupled(request: CurrentRequest, controller: StateSpace) -> dict[str, Any] | None:
    """Spectral radius of both axes together over speed, the other axis with the rules' controller."""
    motor, other = request.motor, "d" if request.axis == "q" else "q"
    assert controller.period_s is not None
    try:
        beside = reduced_design(design_axis(motor, other, rule_weights(motor, other), GAMMA), 3, Method.PAPER)
        other_controller = tustin(
            beside.controller, 1.0 / controller.period_s, beside.margins.phase_margin_rad_s
        )
    except (DesignError, ValueError):
        return None
    d_axis, q_axis = (controller, other_controller) if request.axis == "d" else (other_controller, controller)
    speeds = np.linspace(0.0, motor.rated_speed_rad_s, 5)
    right = nominal_decoupling(motor, request.delay_samples)
    radii = {
        "decoupled": spectral_radius(motor, d_axis, q_axis, speeds, right, request.delay_samples),
        "not_decoupled": spectral_radius(motor, d_axis, q_axis, speeds, None, request.delay_samples),
    }
    return {"speed_rad_s": speeds.tolist(), **{name: value.tolist() for name, value in radii.items()}}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def write_controller(path: Path, result: CurrentResult, axis: str) -> None:
    """The controller as a file for ``current_control`` of a bench: sampled if it was, else continuous."""
    if result.sampled is not None and result.sampled.period_s is not None:
        form = zpk(result.sampled)
        table: dict[str, Any] = {
            "kind": "sampled",
            "axis": axis,
            "sample_rate_hz": round(1.0 / result.sampled.period_s),
            "gain": form.gain,
            "zeros_z": roots(form.zeros),
            "poles_z": roots(form.poles),
        }
    else:
        design = result.chosen
        table = {
            "kind": "continuous",
            "axis": axis,
            "gain": design.form.gain,
            "zeros_rad_s": roots(design.form.zeros),
            "poles_rad_s": roots(design.form.poles),
            "prewarp_rad_s": design.margins.phase_margin_rad_s,
        }
    try:
        path.write_text(toml_text({"current_controller": table}), encoding="utf-8")
    except OSError as error:
        raise BadInput("--out", "", str(path), error.strerror or "a file that can be written") from None
