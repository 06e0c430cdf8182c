"""``hil design current``: from a motor and weights to a controller file, with every figure on the way.

Figures for ``hil design current`` beyond the controller's own axis: sampled, coupled, over a box.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from servobench.design.current.coupled_robustness import coupled_robustness, worst_motor
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
from servobench.design.current.current_loop import (
    Decoupling,
    SampledFigures,
    discrete_design,
    discrete_plant,
    gamma_min_over_rates,
    lowest_coupled_rate_hz,
    lowest_rate_hz,
    nominal_decoupling,
    sampled_figures,
    spectral_radius,
)
from servobench.design.hinf.fixed_structure import Structure, tune
from servobench.design.hinf.mixed_sensitivity import Weights, axis_plant
from servobench.design.hinf.reduction import Method
from servobench.design.hinf.robustness import axis_robustness
from servobench.design.hinf.synthesis import verified_norm
from servobench.design.motor import PmsmParameters
from servobench.design.statespace import StateSpace, to_bilinear, tustin, zpk
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.studies.numbers import finite

FACTOR = 1.05
"""Multiple of the sampled plant's gamma_min, by default if 1 is out of reach."""
RATE_FACTORS = (4.0, 2.0, 1.0, 0.5, 0.25)
"""Multiples of the rate at which gamma_min is computed."""
SPEEDS = 11
"""Standstill, and every tenth of the largest."""
MARGIN_KEPT = 0.9
"""Share of the continuous modulus margin that the lowest rate is to keep by default."""


@dataclass(frozen=True, slots=True, eq=False)
class OtherAxis:
    """The continuous controller of the other axis, and its crossover."""

    controller: StateSpace
    crossover_rad_s: float

    def pair(self, axis: str, own: StateSpace) -> tuple[StateSpace, StateSpace]:
        """Return (K_d, K_q), ``own`` being that of ``axis``."""
        return (own, self.controller) if axis == "d" else (self.controller, own)


@dataclass(frozen=True, slots=True)
class CurrentRequest:
    """The request."""

    motor: PmsmParameters
    axis: str
    weights: Weights | None
    gamma: float | None
    gamma_factor: float | None
    structure: str
    order: int | None
    method: Method
    rate_hz: float | None
    delay_samples: int
    discrete: bool
    """True: the controller is designed for the sampled plant itself."""
    modulus_margin: float | None
    other: OtherAxis | None
    """The other axis' continuous controller; default: by the rules."""
    speed_max_rad_s: float | None
    """Speed up to which the coupled axes are analysed; default: the rated speed."""
    decoupling_factor: float
    """Ratio of the inductances used by the drive's decoupling to the motor's."""
    advance_periods: float | None
    """Angle advance of the drive; default: the correct one."""


def robust_figures(
    motor: PmsmParameters, axis: str, design: AxisDesign, other: OtherAxis, speed_rad_s: float
) -> dict[str, Any]:
    """Return figures over +-50 % of r and L: one axis exactly, both axes at a speed."""
    robustness = axis_robustness(
        motor.resistance_ohm, axis_inductance_h(motor, axis), design.controller, design.weights
    )
    pair = other.pair(axis, design.controller)
    coupled = coupled_robustness(motor, *pair, speed_rad_s)
    worst = worst_motor(motor, *pair, speed_rad_s)
    return {
        "stable": robustness.stable,
        "real_mu_peak": robustness.real_mu_peak,
        "worst_modulus_margin": robustness.worst_modulus_margin,
        "modulus_margin_bound": 1.0 / robustness.sensitivity.bound,
        "worst_weighted_sensitivity": finite(robustness.weighted.reached) if robustness.stable else None,
        "weighted_sensitivity_bound": finite(robustness.weighted.bound) if robustness.stable else None,
        "worst_resistance_ohm": robustness.weighted.resistance_ohm,
        "worst_inductance_h": robustness.weighted.inductance_h,
        "coupled": {
            "speed_rad_s": speed_rad_s,
            "certified": coupled.certified,
            "real_mu_bound": coupled.real_mu_bound,
            "real_mu_rad_s": coupled.real_mu_rad_s,
            "stable_up_to_percent": 50.0 / coupled.real_mu_bound,
            "rightmost_pole_per_s": worst.rightmost_pole_per_s,
            "worst_resistance_ohm": worst.resistance_ohm,
            "worst_inductance_d_h": worst.inductance_d_h,
            "worst_inductance_q_h": worst.inductance_q_h,
        },
    }


def sampled_design(
    request: CurrentRequest, gamma: float, design: AxisDesign, other: OtherAxis, speed_rad_s: float
) -> tuple[StateSpace, dict[str, Any]]:
    """Return the sampled controller and its figures. Raises BadInput for a rate that is too low."""
    assert request.rate_hz is not None
    try:
        beside = OtherAxis(tustin(other.controller, request.rate_hz, other.crossover_rad_s), 0.0)
        controller, discrete = (
            _discrete(request, gamma, design) if request.discrete else (_tustin(request, design), {})
        )
    except ValueError as error:
        raise BadInput("--sample-rate-hz", "", request.rate_hz, str(error)) from None
    sampled = sampled_figures(design.plant, controller, request.delay_samples)
    if sampled.spectral_radius >= 1.0:
        raise BadInput(
            "--sample-rate-hz",
            "",
            request.rate_hz,
            f"a rate at which the loop is stable; its spectral radius is {sampled.spectral_radius:.4f}",
            "sample faster, shorten the delay, lower the crossing of w1, or design with --discrete",
        )
    figures: dict[str, Any] = {
        "rate_hz": request.rate_hz,
        "delay_samples": request.delay_samples,
        "method": "discrete" if request.discrete else "tustin",
        **_loop_figures(sampled),
        **discrete,
        "lowest_rate": _lowest_rate(request, design, other, speed_rad_s),
        "coupled": _coupled(request, beside.pair(request.axis, controller), speed_rad_s),
    }
    return controller, figures


def _tustin(request: CurrentRequest, design: AxisDesign) -> StateSpace:
    assert request.rate_hz is not None
    return tustin(design.controller, request.rate_hz, design.margins.phase_margin_rad_s)


def _discrete(request: CurrentRequest, gamma: float, design: AxisDesign) -> tuple[StateSpace, dict[str, Any]]:
    """Return the controller for the sampled plant, and its figures with those of the sampled continuous
    one."""
    assert request.rate_hz is not None
    plant, weights, delay = design.plant, design.weights, request.delay_samples
    kept = request.gamma if request.gamma is not None else (0.0 if request.gamma_factor else gamma)
    synthesis = discrete_design(plant, weights, kept, request.gamma_factor or FACTOR, request.rate_hz, delay)
    if request.gamma is not None and synthesis.gamma > request.gamma:
        raise BadInput(
            "--gamma",
            "",
            request.gamma,
            f"more than gamma_min = {synthesis.gamma_min:.9g} of the plant sampled at {request.rate_hz:g} Hz",
            "sample faster, shorten the delay, or lower the crossing of w1",
        )
    rates = [request.rate_hz * factor for factor in RATE_FACTORS]
    table = zip(rates, gamma_min_over_rates(plant, weights, rates, delay), strict=True)
    return synthesis.controller, {
        "gamma": synthesis.gamma,
        "gamma_min": synthesis.gamma_min,
        "closed_loop_norm": synthesis.norm,
        "gamma_min_by_rate": [{"rate_hz": rate, "gamma_min": least} for rate, least in table],
        "continuous_sampled": _beside(request, design),
    }


def _beside(request: CurrentRequest, design: AxisDesign) -> dict[str, Any]:
    """Return the figures of the continuous controller by Tustin's rule at the same rate."""
    assert request.rate_hz is not None
    delay = request.delay_samples
    try:
        controller = _tustin(request, design)
    except ValueError:
        return {"spectral_radius": None}
    sampled = sampled_figures(design.plant, controller, delay)
    plant = discrete_plant(design.plant, design.weights, request.rate_hz, delay)
    return {
        **_loop_figures(sampled),
        "closed_loop_norm": finite(verified_norm(plant, to_bilinear(controller))),
    }


def _loop_figures(sampled: SampledFigures) -> dict[str, float | None]:
    return {
        "phase_margin_deg": finite(sampled.margins.phase_margin_deg),
        "gain_margin_db": finite(sampled.margins.gain_margin_db),
        "modulus_margin": finite(sampled.margins.modulus_margin),
        "spectral_radius": sampled.spectral_radius,
    }


def _lowest_rate(
    request: CurrentRequest, design: AxisDesign, other: OtherAxis, speed_rad_s: float
) -> dict[str, float | None]:
    """Return the inner rates that hold the margin of this axis, and both axes stable at speed, by Tustin's
    rule."""
    margin = request.modulus_margin or MARGIN_KEPT * design.margins.modulus_margin
    crossover, delay = design.margins.phase_margin_rad_s, request.delay_samples
    for_margin = lowest_rate_hz(design.plant, design.controller, crossover, margin, delay)
    crossovers = (crossover, other.crossover_rad_s)
    coupled = lowest_coupled_rate_hz(
        request.motor,
        *other.pair(request.axis, design.controller),
        crossovers if request.axis == "d" else crossovers[::-1],
        speed_rad_s,
        delay,
    )
    return {
        "modulus_margin": margin,
        "margin_rate_hz": for_margin,
        "coupled_rate_hz": coupled,
        "rate_hz": None if coupled is None else max(for_margin, coupled),
    }


def _coupled(
    request: CurrentRequest, pair: tuple[StateSpace, StateSpace], speed_rad_s: float
) -> dict[str, Any]:
    """Return the spectral radius of both axes together over speed, with right and wrong decoupling."""
    motor, delay = request.motor, request.delay_samples
    speeds = np.linspace(0.0, speed_rad_s, SPEEDS)
    right = nominal_decoupling(motor, delay)
    advance = right.advance_periods if request.advance_periods is None else request.advance_periods
    factor = request.decoupling_factor
    asked = Decoupling(motor.inductance_d_h * factor, motor.inductance_q_h * factor, advance)
    unturned = Decoupling(motor.inductance_d_h, motor.inductance_q_h, 0.0)

    def radii(decoupling: Decoupling | None) -> list[float]:
        return [float(x) for x in spectral_radius(motor, *pair, speeds, decoupling, delay)]

    figures = {
        "speed_rad_s": speeds.tolist(),
        "decoupled": radii(right),
        "not_decoupled": radii(None),
        "without_advance": radii(unturned),
    }
    if asked != right:
        figures["as_asked"] = radii(asked)
    return {**figures, "decoupling_factor": factor, "advance_periods": advance}


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
