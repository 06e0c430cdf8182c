"""Many runs of the sampled loop with random losses, delays and plants: the limits as chance shows them.

Each run is a load step met at rest, over a network that loses each sample with some probability but never
more than D in a row, with delays even in [0, T], and a plant whose parameters differ from the nominal ones.
``design/core/random_runs.c`` computes a run. Each has its own random stream, made from the seed and its
number: the result depends neither on the number of threads nor on the order of the runs.
"""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import ndtri

from servobench.design.confidence import CONFIDENCE, clopper_pearson
from servobench.design.core.build import check_built
from servobench.design.delay.delay_loop import Array, current_rate_rad_s, speed_model
from servobench.design.errors import CoreNotBuilt, UnsuitableNetwork
from servobench.design.motor import PmsmParameters
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy

_DIVERGED = 1e3
"""A run whose error exceeds the free-running error of the load by this factor has diverged."""
_RUNS_AT_ONCE: Final = 250
"""Runs per call of a thread: some ten milliseconds, after which an interrupt is noticed."""


@dataclass(frozen=True, slots=True)
class Chance:
    """Distributions of the runs, and their length."""

    runs: int
    seed: int
    duration_s: float = 1.0
    loss_probability: float = 0.1
    load_nm: float = 1.0
    uncertainty: float = 0.0
    """Half-width of R, L, J, B and K_t, each drawn evenly: 0.2 means 80 to 120 per cent."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A figure with the limits of its confidence interval of
    :data:`servobench.design.confidence.CONFIDENCE`."""

    value: float
    low: float
    high: float


def diverged(peaks_rad_s: Array) -> Estimate:
    """Return the share of runs that diverged."""
    return share(int(np.count_nonzero(~np.isfinite(peaks_rad_s))), len(peaks_rad_s))


def share(hits: int, n: int) -> Estimate:
    """Return a probability from ``hits`` of ``n``, with Clopper and Pearson's interval."""
    return Estimate(hits / n, *clopper_pearson(hits, n))


def quantile(values: Array, q: float) -> Estimate:
    """Return the quantile ``q`` of a sample; the interval's ends are order statistics, by the binomial
    law."""
    ordered = np.sort(values)
    n = len(ordered)
    spread = float(ndtri(0.5 + 0.5 * CONFIDENCE)) * math.sqrt(n * q * (1.0 - q))
    places = [math.floor(q * (n - 1)), math.floor(n * q - spread), math.ceil(n * q + spread)]
    value, low, high = (float(ordered[min(max(place, 0), n - 1)]) for place in places)
    return Estimate(value, low, high)


def run_many(
    motor: PmsmParameters,
    K: Array,
    network: SampledNetwork,
    chance: Chance,
    current_bandwidth_hz: float | None = None,
) -> Array:
    """Return the (runs,) largest |e| of each, rad/s, inf if it diverged; on all processors available to the
    process.

    ``current_bandwidth_hz``: see :func:`servobench.design.delay.delay_loop.speed_model`; its uncertainty
    follows from R and L.
    """
    check_built("design", CoreNotBuilt)
    from servobench.design.core.native import random_runs

    if network.strategy is Strategy.ARRIVAL and network.delay_max_s > network.period_s * (1.0 + 1e-9):
        raise UnsuitableNetwork(
            f"random runs with a delay of up to {network.delay_max_s * 1e3:g} ms",
            f"at most the period of {network.period_s * 1e3:g} ms, so that samples arrive in order",
        )
    K = np.asarray(K, dtype=float)
    loop = HeldLoop(speed_model(motor, integral=len(K) == 3), K, network)  # checks K against the model
    gains = np.zeros(3)
    gains[: len(loop.K)] = loop.K
    behind = 0 if network.strategy is Strategy.ARRIVAL else loop.kept - len(loop.model.A) - 1
    offset_s = (
        0.0 if network.strategy is Strategy.ARRIVAL else network.agreed_delay_s - behind * network.period_s
    )
    limit = _DIVERGED * max(abs(chance.load_nm), 1e-12) * chance.duration_s / motor.inertia_kg_m2
    plant = [
        current_rate_rad_s(motor, current_bandwidth_hz),
        1.0,
        motor.inertia_kg_m2,
        motor.viscous_friction_nm_s,
        motor.torque_constant_nm_a,
    ]
    delays_s = [network.period_s, network.delay_max_s, max(offset_s, 0.0)]
    chances = [chance.loss_probability, chance.load_nm, limit]
    figures = np.array([*plant, chance.uncertainty, *gains, *delays_s, *chances], dtype=float).tobytes()
    kind = [Strategy.ARRIVAL, Strategy.STAMP, Strategy.HISTORY].index(network.strategy)
    steps = max(1, round(chance.duration_s / network.period_s))

    def peaks_from(first: int) -> bytes:
        count = min(_RUNS_AT_ONCE, chance.runs - first)
        return random_runs(chance.seed, first, count, figures, kind, network.losses_max, behind, steps)

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads:
        return np.frombuffer(b"".join(threads.map(peaks_from, range(0, chance.runs, _RUNS_AT_ONCE)))).copy()
