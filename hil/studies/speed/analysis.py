"""The analysis behind ``hil analyse speed``: figures of a speed loop with delay, exact, certified and by
chance."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from servobench.design.delay.certificate import (
    CLOSE_ENOUGH,
    ORDER_MAX,
    CertifiedGain,
    certified_delay_s,
    certified_gain,
    certified_gain_auto,
)
from servobench.design.delay.delay_loop import Array, DelayLoop, SpeedModel, peak_floor_rad_s, speed_model
from servobench.design.delay.delay_norm import hinf_norm, hinf_peak, largest_stable_delay_s
from servobench.design.delay.delay_response import step_peak
from servobench.design.delay.lmi import SOLVED, SOLVER
from servobench.design.errors import NoSolution
from servobench.design.motor import PmsmParameters
from servobench.design.papers.as_printed import theorem_3_1, theorem_3_3
from servobench.design.sampled.admissible_steps import deliveries_of
from servobench.design.sampled.analysis import SampledAnalysis, analyse_sampled, with_peak
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.design.sampled.loss_patterns import Pattern
from servobench.design.speed.monte_carlo import Chance, Estimate, diverged, quantile, run_many
from servobench.hil.studies.numbers import finite


@dataclass(frozen=True, slots=True, eq=False)
class LoopRequest:
    """A loop to analyse."""

    motor: PmsmParameters
    K: Array
    """Two gains, or three with the integral of the speed error."""
    delay_s: float
    order: int | None
    """Order of the certificate; None: the lowest that comes close to the exact gain."""
    load_nm: float
    speed_rad_s: float
    """Load and speed for the figures in percent."""
    current_bandwidth_hz: float | None = None
    """Bandwidth of the drive's current loop; None: the winding's own, R/L, as in [Ling2012]."""

    @property
    def model(self) -> SpeedModel:
        """Model of the plant."""
        return speed_model(self.motor, len(self.K) == 3, self.current_bandwidth_hz)


def continuous_figures(request: LoopRequest) -> dict[str, Any]:
    """Return figures of the loop with the constant delay, [Ling2012] (2.15). None replaces infinite
    values."""
    model = request.model
    loop = model.loop(request.K, request.delay_s)
    exact = hinf_peak(loop)
    stable = math.isfinite(exact.gain)
    certified, certificate = _certified(model, loop, request.order)
    delay_max_s = largest_stable_delay_s(loop)
    delay_certified_s, delay_order = _certified_delay(model, loop, request.order, delay_max_s)
    peak = step_peak(loop)
    floor = peak_floor_rad_s(request.motor, request.delay_s)
    gamma_certified = math.inf if certified is None else certified.gain
    return {
        "stable": stable,
        "gain": request.K.tolist(),
        "current_bandwidth_hz": request.current_bandwidth_hz,
        "delay_s": request.delay_s,
        "gamma_exact": finite(exact.gain),
        "peak_frequency_rad_s": exact.frequency_rad_s if stable else None,
        "gamma_certified": finite(gamma_certified),
        "order": None if certified is None else certified.order,
        "order_limit_reached": request.order is None
        and stable
        and gamma_certified > CLOSE_ENOUGH * exact.gain,
        "certificate": certificate,
        "delay_max_exact_s": finite(delay_max_s),
        "delay_max_certified_s": finite(delay_certified_s),
        "delay_order": delay_order,
        "step_load_nm": 1.0,
        "step_peak_rad_s": finite(peak),
        "step_peak_floor_rad_s": floor,
        "percent": _percent(request, exact.gain, gamma_certified, peak, floor),
    }


def figures_as_printed(request: LoopRequest) -> dict[str, Any]:
    """Return [Ling2012] Theorems 3.1 and 3.3 with all their matrices, in cvxpy; order 0 is the same,
    faster."""
    model = request.model
    loop = model.loop(request.K, request.delay_s)
    stable = theorem_3_1(loop, model.state_scale)
    about = hinf_norm(loop)
    try:
        gamma = theorem_3_3(loop, model.state_scale, about) if math.isfinite(about) else None
    except NoSolution:
        gamma = None
    order_0, _ = _certified(model, loop, 0)
    return {
        "theorem_3_1_stable": stable,
        "theorem_3_3_gamma": gamma,
        "order_0_gamma": None if order_0 is None else order_0.gain,
    }


def _certified(
    model: SpeedModel, loop: DelayLoop, order: int | None
) -> tuple[CertifiedGain | None, dict[str, Any]]:
    failures = []
    # a functional of higher order contains those of lower ones: what they certify, it does
    for tried in [None] if order is None else range(order, -1, -1):
        try:
            certified = (
                certified_gain_auto(model, loop) if tried is None else certified_gain(model, loop, tried)
            )
        except NoSolution as error:
            failures.append(str(error))
            continue
        status = "; ".join([*failures, f"{SOLVED} at order {certified.order}"])
        return certified, {"solver": SOLVER, "status": status, "min_margin": certified.min_margin}
    return None, {"solver": SOLVER, "status": "; ".join(failures), "min_margin": None}


def _certified_delay(
    model: SpeedModel, loop: DelayLoop, order: int | None, exact_s: float
) -> tuple[float, int]:
    """Return the largest delay certified stable, and the lowest order that comes as close to it."""
    if order is not None:
        return certified_delay_s(model, loop, order), order
    best_s, best_order = 0.0, 0
    for tried in range(ORDER_MAX + 1):
        certified_s = certified_delay_s(model, loop, tried)
        if certified_s > best_s * CLOSE_ENOUGH:
            best_s, best_order = certified_s, tried
        if best_s * CLOSE_ENOUGH >= exact_s:
            break
    return best_s, best_order


def _percent(
    request: LoopRequest, exact: float, certified: float, peak: float, floor: float
) -> dict[str, float | None]:
    share = 100.0 * request.load_nm / request.speed_rad_s
    return {
        "load_nm": request.load_nm,
        "speed_rad_s": request.speed_rad_s,
        "gamma_exact": finite(exact * share),
        "gamma_certified": finite(certified * share),
        "step_peak_rad_s": finite(peak * request.load_nm),
        "step_peak": finite(peak * share),
        "step_peak_floor": floor * share,
    }


def sampled_figures(request: LoopRequest, network: SampledNetwork) -> dict[str, Any]:
    """Return figures of the loop as it runs, over ``network``."""
    analysis = with_peak(analyse_sampled(request.model, request.K, network))
    return {
        **network_figures(network),
        "age_max_s": network.age_max_s,
        **sequence_figures(analysis, 100.0 * request.load_nm / request.speed_rad_s),
        "by_losses": [
            {"lost": lost, "decay_per_s": finite(pattern.decay_per_s), "gamma": finite(gain)}
            for lost, (pattern, gain) in enumerate(zip(analysis.regular, analysis.gains, strict=True))
        ],
    }


def network_figures(network: SampledNetwork) -> dict[str, Any]:
    """Return the figures of a loop's network."""
    return {
        "strategy": network.strategy.value,
        "period_s": network.period_s,
        "loss_max": network.losses_max,
        "tau_max_s": network.delay_max_s,
        "agreed_delay_s": None if network.strategy is Strategy.ARRIVAL else network.agreed_delay_s,
        **({"sync_within_s": network.uneven_s} if network.uneven_s else {}),
    }


def sequence_figures(analysis: SampledAnalysis, percent: float) -> dict[str, Any]:
    """Return the guarantees under every sequence, with the worst case found.

    ``percent``: share of the speed, for a gain of 1 rad/s per N m.
    """
    gain, proofs = analysis.gain_certified, [analysis.gain_proof, analysis.decay_proof]
    margins = [proof.min_margin for proof in proofs if proof is not None]
    peak, bound = analysis.peak_found, analysis.peak_certified
    return {
        "certified": analysis.certified,
        "refuted": analysis.refuted,
        "sequences": {
            "step_peak_rad_s": _bounds(bound, peak),
            "step_peak_percent": _bounds(None if bound is None else bound * percent, peak * percent),
            "gain": _bounds(gain, analysis.gain_found),
            "error_percent": _bounds(None if gain is None else gain * percent, analysis.gain_found * percent),
            "decay_per_s": _bounds(analysis.decay_certified_per_s, analysis.decay_found_per_s),
            "gain_pattern": _pattern(analysis.network, analysis.worst.pattern),
            "decay_pattern": _pattern(analysis.network, analysis.slowest),
        },
        "sequence_certificate": {
            "solver": SOLVER,
            "status": analysis.without_certificate or SOLVED,
            "min_margin": min(margins) if analysis.certified else None,
        },
    }


def _bounds(certified: float | None, found: float) -> dict[str, float | None]:
    """Return a figure from both sides, and the gap in percent of the one found."""
    gap = None
    if certified is not None and math.isfinite(found):
        gap = 100.0 * abs(certified - found) / abs(found)
    return {"certified": certified, "found": finite(found), "gap_percent": gap}


def _pattern(network: SampledNetwork, pattern: Pattern) -> list[dict[str, Any]]:
    return [
        {"delay_s": delivery.delay_s, "lost_after": delivery.interval - 1}
        for delivery in deliveries_of(network, pattern.steps)
    ]


def chance_figures(request: LoopRequest, network: SampledNetwork, chance: Chance) -> dict[str, Any]:
    """Return figures of many random runs of the sampled loop under a step of the load; limits at 95 %
    confidence."""
    peaks_rad_s = run_many(request.motor, request.K, network, chance, request.current_bandwidth_hz)
    share = 100.0 / request.speed_rad_s
    quantiles = {f"p{100 * q:g}": quantile(peaks_rad_s, q) for q in (0.5, 0.9, 0.99)}
    return {
        "runs": chance.runs,
        "seed": chance.seed,
        "duration_s": chance.duration_s,
        "loss_probability": chance.loss_probability,
        "load_nm": chance.load_nm,
        "diverged": _estimate(diverged(peaks_rad_s)),
        "peak_rad_s": {name: _estimate(value) for name, value in quantiles.items()},
        "peak_percent": {name: _estimate(value, share) for name, value in quantiles.items()},
        "largest_peak_rad_s": finite(float(np.max(peaks_rad_s))),
    }


def _estimate(estimate: Estimate, factor: float = 1.0) -> Mapping[str, float | None]:
    return {
        "value": finite(estimate.value * factor),
        "low": finite(estimate.low * factor),
        "high": finite(estimate.high * factor),
    }
