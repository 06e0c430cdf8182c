"""Robustness of a speed loop beyond its design conditions.

The margins are those of L = -K (s I - A)^{-1} B1 e^{-s eta}, the loop cut at its input, with one constant
delay: the largest age of a sample, so that they are the worst case. The noise is that of the sampled loop, or
with a constant delay that passed on by the speed gain.

A controller with states, a predictor's or an H-infinity one's, has figures of its own; the other plants are
those of every speed loop.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from servobench.design.delay.delay_loop import Array, DelayLoop, SpeedModel, peak_floor_rad_s
from servobench.design.delay.delay_norm import hinf_norm, largest_stable_delay_s
from servobench.design.delay.delay_response import step_peak
from servobench.design.hinf.margins import Margins, margins_of
from servobench.design.motor import PmsmParameters
from servobench.design.sampled.admissible_steps import Delivery
from servobench.design.sampled.held_loop import HeldLoop
from servobench.design.sampled.loss_patterns import Pattern, chain_of, pattern_gains, pattern_of, repeated
from servobench.design.statespace import ComplexArray

LOST: Final = 5
"""Consecutive samples that a trial loses before the first one after the step."""
CHANGES: Final[Mapping[str, tuple[float, float]]] = {
    "inertia_70_percent": (0.7, 1.0),
    "inertia_130_percent": (1.3, 1.0),
    "current_bandwidth_50_percent": (1.0, 0.5),
}
"""Multiples of the inertia and of the current loop's bandwidth for the other plants."""


@dataclass(frozen=True, slots=True)
class LoopRobustness:
    """Exact figures, except for the peaks, which come from trials without noise."""

    peaks_over_floor: Mapping[str, float]
    """Peaks after the step of the load, as :func:`peaks_over_floor` names them."""
    gain: float
    """L2 gain from load torque to speed error, rad/s per N m, with every sample received."""
    gains: Mapping[str, float]
    """With the plants of :data:`CHANGES`; inf: unstable."""
    bandwidths: tuple[float, float]
    """Range of stable current-loop bandwidths, as shares of its own; by steps of a tenth, down to a half and
    up to twice."""
    margins: Margins
    delay_margin_s: float
    command_noise_nm: float


def peaks_over_floor(ratio: Callable[[float, int], float]) -> dict[str, float]:
    """Name the peaks. ``ratio``: peak over its own floor, for a multiple of the inertia, and for a number of
    samples lost in a row before the first one after the step."""
    return {
        "peak_over_floor": ratio(1.0, 0),
        "peak_over_floor_inertia_70_percent": ratio(0.7, 0),
        "peak_over_floor_inertia_130_percent": ratio(1.3, 0),
        f"peak_over_floor_{LOST}_lost": ratio(1.0, LOST),
    }


def stable_bandwidths(stable: Callable[[float], bool]) -> tuple[float, float]:
    """Return the ``bandwidths`` of a loop that is ``stable`` with the current loop's bandwidth times a
    share."""
    return _last(stable, -0.1, 0.5), _last(stable, 0.1, 2.0)


def _last(stable: Callable[[float], bool], step: float, end: float) -> float:
    reached = 1.0
    while abs(end - reached) > 0.5 * abs(step):
        if not stable(reached + step):
            return reached
        reached += step
    return reached


_DECADES = 1e4
"""Range around the loop's rates, either way, searched for crossings."""


@dataclass(frozen=True, slots=True)
class Changed:
    """Gains with a plant other than the design's, rad/s per N m; inf: unstable."""

    gain: float
    """With the constant delay."""
    gain_found: float | None
    """Largest gain under the patterns that are worst for the design's plant; None: no network is known."""


@dataclass(frozen=True, slots=True)
class SpeedRobustness:
    """Figures of one speed loop."""

    peak_over_floor: float
    """Largest error after a load step, over the least that any controller reaches with this delay."""
    margins: Margins
    delay_margin_s: float
    """Beyond the design's delay, up to instability."""
    changed: Mapping[str, Changed]
    """With the plants of :data:`CHANGES`."""
    noise_nm_s_rad: float
    """Torque command, N m rms, that 1 rad/s rms of white noise on each speed sample makes."""


def _heavier(motor: PmsmParameters, share: float) -> PmsmParameters:
    """Return the motor with all its inertia so many times as large, on both sides of a coupling."""
    heavier = replace(motor, inertia_kg_m2=share * motor.inertia_kg_m2)
    mechanism = motor.mechanism
    if mechanism is None or mechanism.coupling is None:
        return heavier
    return replace(heavier, mechanism=replace(mechanism, coupling=mechanism.coupling.scaled(share)))


def speed_robustness(
    plant: Callable[[PmsmParameters, float], SpeedModel],
    motor: PmsmParameters,
    loop: DelayLoop,
    held: HeldLoop | None,
    patterns: list[Pattern],
) -> SpeedRobustness:
    """Compute the figures.

    ``plant``: model of a motor whose current loop has so many times the design's rate; ``held``: the
    sampled loop, if a network is known, with the ``patterns`` that are worst for it.
    """

    def changed(inertia: float, rate: float) -> Changed:
        model = plant(_heavier(motor, inertia), rate)
        constant = hinf_norm(model.loop(loop.K, loop.delay_s))
        if held is None:
            return Changed(constant, None)
        other = HeldLoop(model, held.K, held.network)
        same = [pattern_of(other, pattern.steps) for pattern in patterns]
        return Changed(constant, float(np.max(pattern_gains(other, same, 1e-4))))

    return SpeedRobustness(
        step_peak(loop) / peak_floor_rad_s(motor, loop.delay_s) if loop.delay_s > 0.0 else math.inf,
        loop_margins(loop),
        max(0.0, largest_stable_delay_s(loop) - loop.delay_s),
        {name: changed(*change) for name, change in CHANGES.items()},
        noise_gain(motor, loop, held),
    )


def loop_margins(loop: DelayLoop) -> Margins:
    """Return the margins of the loop cut at its input."""

    def response(omega: Array) -> ComplexArray:
        s = 1j * omega[:, None, None]
        column = np.broadcast_to(loop.B[:, None], (len(omega), len(loop.B), 1))
        inner = np.linalg.solve(s * np.eye(len(loop.A)) - loop.A, column)[:, :, 0]
        return np.asarray(-(inner @ loop.K) * np.exp(-1j * omega * loop.delay_s))

    rate = float(np.max(np.abs(np.linalg.eigvals(loop.A))))
    return margins_of(response, rate / _DECADES, rate * math.sqrt(_DECADES))


def noise_gain(motor: PmsmParameters, loop: DelayLoop, held: HeldLoop | None) -> float:
    """Return N m rms of torque command by 1 rad/s rms of white noise on each speed sample; inf if
    unstable."""
    own = motor.torque_constant_nm_a * abs(float(loop.K[1]))
    if held is None:
        return own
    # every sample comes, as late as it may: v_0 = K x + K2 noise, and the loop feeds it back
    pattern = repeated(held, (Delivery(1, held.network.delay_max_s),))
    if pattern.decay_per_s <= 0.0:
        return math.inf
    n, k = len(held.model.A), held.kept
    chain = chain_of(held, pattern)
    noise = np.zeros(held.size)
    noise[n + 1] = held.K[1]
    entered = (held.transition(chain[1:]) @ noise)[:k]
    covariance = solve_discrete_lyapunov(held.kept_transition(chain), np.outer(entered, entered))
    row = np.append(held.K, np.zeros(k - n))
    return motor.torque_constant_nm_a * math.sqrt(float(row @ covariance @ row) + float(held.K[1]) ** 2)
