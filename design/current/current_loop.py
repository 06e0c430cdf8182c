"""A current controller in a drive: sampled at the inner rate, its voltage put out a computation delay later.

Two ways to a sampled controller: the continuous one by Tustin's rule, prewarped at the crossover, or a
design for the sampled plant itself, with its hold and delay, in the bilinear plane (s = 2/T (z-1)/(z+1)).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from servobench.design.errors import InfeasibleDesign
from servobench.design.hinf.bilinear import from_bilinear, to_bilinear, tustin
from servobench.design.hinf.margins import Margins, margins
from servobench.design.hinf.mixed_sensitivity import mixed_sensitivity
from servobench.design.hinf.plant import GeneralisedPlant
from servobench.design.hinf.synthesis import gamma_min, synthesise, verified_norm
from servobench.design.hinf.weights import Weights
from servobench.design.statespace import StateSpace, balanced, connect, series, state_space

RATE_MAX_HZ = 1_000_000.0
"""Upper end of a search: no drive samples its currents as fast. From 10 kHz or 1 GHz on it ends at the same
rate with the paper's q axis."""


@dataclass(frozen=True, slots=True)
class SampledFigures:
    """A sampled loop: its margins and the largest magnitude of a closed-loop pole."""

    margins: Margins
    spectral_radius: float


def held(plant: StateSpace, rate_hz: float, delay_samples: int) -> StateSpace:
    """Return ``plant`` behind a zero-order hold and ``delay_samples`` whole periods of computation."""
    period_s = 1.0 / rate_hz
    n, m = plant.order, plant.B.shape[1]
    joint = np.zeros((n + m, n + m))
    joint[:n, :n], joint[:n, n:] = plant.A, plant.B
    grown = scipy.linalg.expm(joint * period_s)
    sampled = StateSpace(grown[:n, :n], grown[:n, n:], plant.C, plant.D, period_s)
    for _ in range(delay_samples):
        sampled = series(sampled, state_space([[0.0]], [[1.0]], [[1.0]], [[0.0]], period_s))
    return sampled


def sampled_figures(G: StateSpace, K: StateSpace, delay_samples: int) -> SampledFigures:
    """Return margins and spectral radius of the sampled controller ``K`` on the continuous plant ``G``."""
    assert K.period_s is not None
    loop = series(held(G, 1.0 / K.period_s, delay_samples), K)
    closed = connect(loop, [[-1.0]], [[1.0]], [[1.0]])
    return SampledFigures(margins(loop), float(np.abs(closed.poles()).max()))


@dataclass(frozen=True, slots=True, eq=False)
class DiscreteDesign:
    """A controller made for the sampled plant itself."""

    controller: StateSpace
    gamma: float
    gamma_min: float
    """Least gamma of the sampled plant with its hold and delay."""
    norm: float
    """Norm of the controller there."""


def discrete_plant(G: StateSpace, weights: Weights, rate_hz: float, delay_samples: int) -> GeneralisedPlant:
    """Return the mixed-sensitivity problem of the sampled plant, in the bilinear plane, where its norm is the
    same.

    The weights are those of the continuous problem in that plane: at a real frequency w they have their value
    at 2/T tan(w T/2).
    """
    return mixed_sensitivity(to_bilinear(balanced(held(G, rate_hz, delay_samples))), weights)


def discrete_design(
    G: StateSpace, weights: Weights, gamma: float, factor: float, rate_hz: float, delay_samples: int
) -> DiscreteDesign:
    """Design for ``gamma``, or for ``factor`` times the sampled plant's gamma_min if that is more."""
    plant = discrete_plant(G, weights, rate_hz, delay_samples)
    least = gamma_min(plant)
    reached = max(gamma, factor * least)
    K = synthesise(plant, reached).controller
    return DiscreteDesign(from_bilinear(K, 1.0 / rate_hz), reached, least, verified_norm(plant, K))


def gamma_min_over_rates(
    G: StateSpace, weights: Weights, rates_hz: Sequence[float], delay_samples: int
) -> list[float]:
    """Return gamma_min of the sampled plant at each rate: the later the voltage comes, the larger."""
    return [gamma_min(discrete_plant(G, weights, rate, delay_samples)) for rate in rates_hz]


def lowest_rate_hz(
    G: StateSpace, K: StateSpace, crossover_rad_s: float, modulus_margin: float, delay_samples: int
) -> float:
    """Return the lowest sampling rate, to 0.1 %, at and above which Tustin's ``K`` holds ``modulus_margin``.

    Raises InfeasibleDesign if the continuous loop itself has no such margin.
    """

    def holds(rate_hz: float) -> bool:
        if rate_hz <= 1.05 * crossover_rad_s / math.pi:
            return False
        figures = sampled_figures(G, tustin(K, rate_hz, crossover_rad_s), delay_samples)
        return figures.spectral_radius < 1.0 and figures.margins.modulus_margin >= modulus_margin

    rate_hz = lowest_rate(holds, 1e-3)
    if rate_hz is None:
        best = margins(series(G, K)).modulus_margin
        raise InfeasibleDesign(
            f"a modulus margin of {modulus_margin:g}",
            f"the continuous loop has {best:.4f}",
            "ask for less, or lower the crossing of w1",
        )
    return rate_hz


def lowest_rate(holds: Callable[[float], bool], relative: float) -> float | None:
    """Return the lowest rate, Hz, at and above which ``holds``; None if not even at ``RATE_MAX_HZ``."""
    low = high = RATE_MAX_HZ
    if not holds(high):
        return None
    while low > 10.0 and holds(low / 1.25):  # downwards, so that it holds at every rate above
        low /= 1.25
    high, low = low, low / 1.25
    while high / low > 1.0 + relative:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
