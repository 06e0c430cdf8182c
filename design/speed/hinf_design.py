"""The H-infinity controller whose speed peaks least after a load step, within what it must bear.

search      three weights: on the speed error, of the noise, and where the integral ends
for each    the central controller of :mod:`design.speed.hinf_problem`
least       the largest peak over its own floor, of the motor and of +-30 % of its inertia, with a price on
            what is not kept: delay margin and inertias, by the poles of those very loops, and torque noise

The order is then lowered as far as nothing is lost by it.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.optimize

from design.delay.delay_loop import Array
from design.errors import DesignError
from design.speed.conditioned import Conditioned, conditioned, truncated
from design.speed.hinf_loop import HinfLoop
from design.speed.hinf_problem import (
    HinfController,
    HinfWeights,
    design_controller,
    weighted_norms,
)
from design.speed.loop_robustness import CHANGES, LoopRobustness, peaks_over_floor, stable_bandwidths
from design.speed.plant_loop import later_s
from design.speed.predictor_design import PHASES, WORST, PredictorRequest, peak_cost

_SETTLED = 0.999
"""Magnitude of the slowest pole that the loops above may have."""
_NOISE_SHARE = 0.95
"""Of the torque noise that is allowed: that of an encoder on a drive is not quite white."""
_PRICE = 30.0
_STARTS = ((1.0, 1.0), (1.0, 0.1), (0.3, 0.3))
"""Of sigma and nu, in sizes of the problem."""
_INTEGRAL = 0.3
"""omega_i times h + tau, at the start."""
_EVALUATIONS = 60
_ORDER_PRICE = 2e-3
"""What the reduction may add to the cost."""


@dataclass(frozen=True, eq=False)
class HinfDesign:
    """A controller, reduced, and where it is from."""

    request: PredictorRequest
    weights: HinfWeights
    found: HinfController
    controller: Conditioned

    def loop(self, inertia: float = 1.0, current: float = 1.0, more_s: float = 0.0) -> HinfLoop:
        """Around another plant, or with a longer delay."""
        plant = self.request.plant.changed(inertia, current)
        return HinfLoop(self.controller, plant, self.request.delay_s + more_s)

    def ratio(self, inertia: float, lost: int = 0) -> float:
        """Peak after the step over the floor of that inertia, both without noise."""
        request = self.request
        periods = math.ceil(4.0 * (request.delay_s / request.period_s + 1.0)) + 10 + 2 * lost
        speeds = self.loop(inertia).load_steps(request.load_nm, periods, PHASES, lost)
        return float(np.max(np.abs(speeds))) / request.floor_rad_s(inertia, lost)

    @cached_property
    def noise_nm(self) -> float:
        """Rms of the command by the samples' noise."""
        return self.loop().torque_noise_nm(self.request.speed_noise_rad_s)

    @cached_property
    def breach(self) -> float:
        """How much of what must be kept is not; 0: all is."""
        request = self.request
        loops = (self.loop(inertia, more_s=more_s) for inertia, more_s in request.borne)
        radius = max(loop.spectral_radius() for loop in loops)
        if radius >= 1.0:
            return radius
        noise = self.noise_nm / (_NOISE_SHARE * request.command_noise_nm)
        return max(0.0, radius - _SETTLED) + max(0.0, noise - 1.0)

    @cached_property
    def cost(self) -> float:
        """What the search makes least."""
        cost = peak_cost(self.ratio) + _PRICE * self.breach
        return min(cost, WORST) if math.isfinite(cost) else WORST


def design_hinf(request: PredictorRequest) -> HinfDesign:
    """The design. Raises InfeasibleDesign where nothing keeps what is asked."""
    around_s = request.period_s + request.delay_s
    unit = request.floor_rad_s() / request.load_nm

    def weights(point: Array) -> HinfWeights:
        error, noise, integral = np.exp(point)
        return HinfWeights(error / unit, noise * unit, integral / around_s)

    def full(point: Array) -> HinfDesign | None:
        try:
            controller = design_controller(request, weights(point))
            whole = conditioned(controller.K, unit)
        except (DesignError, np.linalg.LinAlgError):
            return None
        return HinfDesign(request, weights(point), controller, whole)

    best: HinfDesign | None = None

    def cost(point: Array) -> float:
        nonlocal best
        made = full(point)
        if made is None:
            return WORST
        # what keeps all by a hair's breadth has neighbours that cost less and do not
        if made.breach == 0.0 and (best is None or made.cost < best.cost):
            best = made
        return made.cost

    starts = [np.log([error, noise, _INTEGRAL]) for error, noise in _STARTS]
    simplex = min(starts, key=cost)
    scipy.optimize.minimize(
        cost,
        simplex,
        method="Nelder-Mead",
        options={
            "maxfev": _EVALUATIONS,
            "xatol": 2e-2,
            "fatol": 1e-3,
            "initial_simplex": simplex + np.vstack([np.zeros(3), 0.5 * np.eye(3)]),
        },
    )
    if best is None:
        raise request.unkept("H-infinity controller")
    return _reduced(best, unit)


def _reduced(made: HinfDesign, unit: float) -> HinfDesign:
    """With the fewest states that cost nothing."""
    for fewer in truncated(made.controller, unit):
        reduced = replace(made, controller=fewer)
        if reduced.loop().spectral_radius() < 1.0 and reduced.cost <= made.cost + _ORDER_PRICE:
            return reduced
    return made


def hinf_robustness(made: HinfDesign) -> LoopRobustness:
    """The figures with the reduced controller."""
    request = made.request

    def gain(inertia: float = 1.0, current: float = 1.0) -> float:
        loop = made.loop(inertia, current)
        return loop.gain(loop.chain())

    def stable(delay_s: float) -> bool:
        return HinfLoop(made.controller, request.plant, delay_s).spectral_radius() < 1.0

    return LoopRobustness(
        peaks_over_floor(made.ratio),
        gain(),
        {name: gain(*change) for name, change in CHANGES.items()},
        stable_bandwidths(lambda share: made.loop(current=share).spectral_radius() < 1.0),
        made.loop().margins(),
        later_s(stable, request.delay_s, request.period_s),
        made.noise_nm,
    )


def uncertainty_norm(made: HinfDesign) -> float:
    """Peak of |W T|: below 1 every inertia and delay that W covers leaves the loop stable."""
    h = made.request.period_s
    omega = np.concatenate([np.geomspace(1e-3 / h, math.pi / h, 2000), np.linspace(1.0, math.pi / h, 2000)])
    return float(np.max(weighted_norms(made.request, made.controller.K, omega)))
