"""``hil design current``: from a motor and weights to a controller file, with every figure on the way."""

from dataclasses import dataclass
from typing import Any

from servobench.design.current.current_design import (
    AxisDesign,
    axis_gamma_min,
    axis_inductance_h,
    describe,
    design_axis,
    design_figures,
    reduced_design,
    roots,
    rule_weights,
)
from servobench.design.hinf.fixed_structure import Structure, tune
from servobench.design.hinf.mixed_sensitivity import axis_plant
from servobench.design.hinf.reduction import Method
from servobench.design.motor import PmsmParameters
from servobench.design.statespace import StateSpace, zpk
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.studies.current.figures import CurrentRequest, OtherAxis, robust_figures, sampled_design

GAMMA = 1.0
"""The default demand (40)."""
FACTOR_MIN = 1.0005
"""Least factor of gamma above gamma_min for a usable controller."""


@dataclass(frozen=True, slots=True, eq=False)
class CurrentResult:
    """Result: the designs, the controller to run, and the figures for ``--json``."""

    full: AxisDesign
    chosen: AxisDesign
    sampled: StateSpace | None
    figures: dict[str, Any]


def design_current(request: CurrentRequest) -> CurrentResult:
    """Synthesise, reduce, discretise, with the figures of all. Raises DesignError and BadInput."""
    motor, axis = request.motor, request.axis
    weights = request.weights or rule_weights(motor, axis)
    plant = axis_plant(motor.resistance_ohm, axis_inductance_h(motor, axis))
    least = axis_gamma_min(plant, weights)
    gamma = _gamma(request, least)
    full = design_axis(motor, axis, weights, gamma)
    chosen = full
    if request.structure != "full":
        tuned, _ = tune(plant, weights, Structure(request.structure), full.margins.phase_margin_rad_s)
        chosen = describe(plant, weights, tuned, least)
    reduced = _reduced(chosen, request)
    figures = design_figures(chosen, reduced)
    figures["axis"], figures["structure"], figures["gamma"] = axis, request.structure, gamma
    figures["gamma_full_order"] = full.closed_loop_norm
    chosen = reduced or chosen
    speed = motor.rated_speed_rad_s if request.speed_max_rad_s is None else request.speed_max_rad_s
    other = request.other or _by_rules(motor, "d" if axis == "q" else "q")
    figures["robust"] = robust_figures(motor, axis, chosen, other, speed)
    sampled = None
    if request.rate_hz is not None:
        sampled, figures["sampled"] = sampled_design(request, gamma, chosen, other, speed)
    return CurrentResult(full, chosen, sampled, figures)


def _gamma(request: CurrentRequest, least: float) -> float:
    """Return the upper bound of the norm. Raises BadInput next to gamma_min, where one pole runs to
    infinity."""
    gamma, option = GAMMA, "--gamma"
    if request.gamma_factor is not None:
        gamma, option = request.gamma_factor * least, "--gamma-factor"
    elif request.gamma is not None:
        gamma = request.gamma
    if least <= gamma < FACTOR_MIN * least:
        raise BadInput(
            option,
            "",
            gamma if option == "--gamma" else request.gamma_factor,
            f"at least {FACTOR_MIN:g} times gamma_min = {least:.9g}",
            "at gamma_min itself a pole of the controller runs to infinity",
        )
    return gamma


def _reduced(design: AxisDesign, request: CurrentRequest) -> AxisDesign | None:
    if request.order is None:
        return None
    try:
        return reduced_design(design, request.order, request.method)
    except ValueError as error:
        raise BadInput("--reduce", "", request.order, str(error)) from None


def _by_rules(motor: PmsmParameters, axis: str) -> OtherAxis:
    """Return the other axis with the rules' weights, in the paper's third order."""
    design = reduced_design(design_axis(motor, axis, rule_weights(motor, axis), GAMMA), 3, Method.PAPER)
    return OtherAxis(design.controller, design.margins.phase_margin_rad_s)


def controller_text(result: CurrentResult, axis: str) -> str:
    """Return the controller as a file for ``current_control`` of a bench: sampled if it was, else
    continuous."""
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
    return toml_text({"current_controller": table})
