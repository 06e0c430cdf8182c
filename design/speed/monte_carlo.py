"""Many runs of the sampled loop with random losses, delays and plants: what chance makes of the limits.

Each run is a load step met at rest, over a network that loses each sample with some probability but
never more than D in a row, with delays even in [0, T], and a plant whose parameters differ from the
nominal ones. The plant is solved exactly from switching to switching, so the step is the sampling
period's and there is no integration error:

    e_q' = a (u - e_q)      e' = c e_q - b e + g d      q' = e

Each run has a random stream of its own, made from the seed and its number: the result depends neither
on the number of threads nor on the order of the runs.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from design.confidence import CONFIDENCE, clopper_pearson
from design.delay.delay_loop import Array
from design.delay.speed_loop import current_rate_rad_s, speed_model
from design.errors import UnsuitableNetwork
from design.kept_code import kept
from design.motor import PmsmParameters
from design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy

_DIVERGED = 1e3
"""A run whose error exceeds the free-running error of the load by this factor has diverged."""
_SMALL = 1e-4
"""Of b t: the series leave 1e-9 of the integrals there; the differences of doubles leave 3e-10, and 1e-7 at a
tenth of it."""
_F = TypeVar("_F", bound=Callable[..., Any])


def _kernel(function: _F) -> _F:
    """Without fastmath."""
    return kept(function, nogil=True, error_model="numpy")


def _parallel(function: _F) -> _F:
    """The same with its ``prange`` on all threads."""
    return kept(function, nogil=True, error_model="numpy", parallel=True)


@dataclass(frozen=True, slots=True)
class Chance:
    """What the runs draw from, and how long each is."""

    runs: int
    seed: int
    duration_s: float = 1.0
    loss_probability: float = 0.1
    load_nm: float = 1.0
    uncertainty: float = 0.0
    """Of R, L, J, B and K_t, each drawn evenly: 0.2 means 80 to 120 per cent."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A figure with the limits of its confidence interval of :data:`design.confidence.CONFIDENCE`."""

    value: float
    low: float
    high: float


def diverged(peaks_rad_s: Array) -> Estimate:
    """Share of runs that diverged."""
    return share(int(np.count_nonzero(~np.isfinite(peaks_rad_s))), len(peaks_rad_s))


def share(hits: int, n: int) -> Estimate:
    """A probability from ``hits`` of ``n``, with Clopper and Pearson's interval."""
    return Estimate(hits / n, *clopper_pearson(hits, n))


def quantile(values: Array, q: float) -> Estimate:
    """Quantile ``q`` of a sample; the interval's ends are order statistics, by the binomial law."""
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
    """(runs,) largest |e| of each, rad/s, inf where it diverged, on as many threads as numba has.

    ``current_bandwidth_hz``: as of :func:`design.delay.speed_loop.speed_model`; the uncertainties of R and L
    make its.
    """
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
    plant = np.array(
        [
            current_rate_rad_s(motor, current_bandwidth_hz),
            1.0,
            motor.inertia_kg_m2,
            motor.viscous_friction_nm_s,
            motor.torque_constant_nm_a,
        ]
    )
    steps = max(1, round(chance.duration_s / network.period_s))
    settings = np.array(
        [network.period_s, network.delay_max_s, max(offset_s, 0.0), chance.loss_probability, chance.load_nm]
    )
    limit = _DIVERGED * max(abs(chance.load_nm), 1e-12) * chance.duration_s / motor.inertia_kg_m2
    kinds = {Strategy.ARRIVAL: 0, Strategy.STAMP: 1, Strategy.HISTORY: 2}
    peaks = np.empty(chance.runs)
    _run_all(
        np.uint64(chance.seed), plant, chance.uncertainty, gains, settings, kinds[network.strategy],
        network.losses_max, behind, steps, limit, peaks,
    )  # fmt: skip
    return peaks


@_kernel
def _mixed(x: np.uint64) -> np.uint64:
    """The finaliser of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014)."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@_kernel
def _even(x: np.uint64) -> float:
    """In [0, 1)."""
    return (x >> np.uint64(11)) * 2.0**-53


@_kernel
def _rest(b: float, t: float, E: float) -> float:
    """(1 - e^{-bt})/b, with E = e^{-bt}, and its limit t for b = 0."""
    x = b * t
    return t * (1.0 - x * (0.5 - x / 6.0)) if x < _SMALL else (1.0 - E) / b


@_kernel
def _decayed(x: float) -> float:
    """e^{-x}; friction is slow, so x nearly always is small and the series exact to rounding."""
    return 1.0 - x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x / 24.0))) if x < 1e-3 else math.exp(-x)


@_kernel
def _flow(
    x: NDArray[np.float64], a: float, b: float, c: float, g: float, u: float, d: float, t: float,
    E_a: float, E_b: float,
) -> float:  # fmt: skip
    """x = [e_q, e, q] after ``t`` with u and d held, and the largest |e| on the way.

    E_a = e^{-at}, E_b = e^{-bt}.
    """
    e_q, e = x[0], x[1]
    slope, off = c * e_q - b * e + g * d, e_q - u
    phi = _rest(b, t, E_b)
    bt = b * t
    psi = t * t * (0.5 - bt / 6.0) if bt < _SMALL else (t - phi) / b
    drive = c * u + g * d
    mix = c * off / (b - a)
    x[2] += x[1] * phi + drive * psi + mix * ((1.0 - E_a) / a - phi)
    x[1] = x[1] * E_b + drive * phi + mix * (E_a - E_b)
    x[0] = u + off * E_a
    top: float = max(abs(e), abs(x[1]))
    if slope * (c * x[0] - b * x[1] + g * d) < 0.0:
        top = max(top, _summit(e_q, e, a, b, c, g, u, d, t, slope))
    return top


@_kernel
def _summit(
    e_q: float, e: float, a: float, b: float, c: float, g: float, u: float, d: float, t: float, slope: float
) -> float:
    """|e| where its slope, ``slope`` at the start, passes through zero before ``t``."""
    low, high, top = 0.0, t, e
    off, drive = e_q - u, c * u + g * d
    for _ in range(40):
        middle = 0.5 * (low + high)
        E_a, E_b = math.exp(-a * middle), math.exp(-b * middle)
        top = e * E_b + drive * _rest(b, middle, E_b) + c * off / (b - a) * (E_a - E_b)
        if slope * (c * (u + off * E_a) - b * top + g * d) > 0.0:
            low = middle
        else:
            high = middle
    return abs(top)


@_kernel
def _run(
    state: np.uint64, plant: Array, width: float, K: Array, settings: Array, kind: int, losses_max: int,
    behind: int, steps: int, limit: float,
) -> float:  # fmt: skip
    """One run: largest |e|."""
    golden = np.uint64(0x9E3779B97F4A7C15)
    drawn = np.empty(5)
    for k in range(5):
        state += golden
        drawn[k] = plant[k] * (1.0 + width * (2.0 * _even(_mixed(state)) - 1.0))
    a, b = drawn[0] / drawn[1], drawn[3] / drawn[2]
    c, g = drawn[4] / drawn[2], 1.0 / drawn[2]
    if abs(b - a) < 1e-9 * a:
        b = a * (1.0 - 1e-9)
    h, T, offset, loss, load = settings
    E_ah, E_bh = math.exp(-a * h), math.exp(-b * h)
    E_ao, E_bo = math.exp(-a * offset), math.exp(-b * offset)
    values, came = np.zeros(behind + 1), np.zeros(behind + 1, np.bool_)
    x = np.zeros(3)
    held, lost = 0.0, 0
    state += golden
    # the load steps somewhere in the first period; at rest nothing else has happened before
    late = h * _even(_mixed(state))
    peak = _flow(x, a, b, c, g, 0.0, load, h - late, math.exp(-a * (h - late)), math.exp(-b * (h - late)))
    for k in range(steps):
        slot = k % (behind + 1)
        values[slot] = K[0] * x[0] + K[1] * x[1] + K[2] * x[2]
        state += golden
        delivered = lost >= losses_max or _even(_mixed(state)) >= loss
        lost = 0 if delivered else lost + 1
        came[slot] = delivered or kind == 2
        oldest = (k + 1) % (behind + 1)
        if kind == 0:
            state += golden
            at = T * _even(_mixed(state))
            if delivered:
                E_a, E_b = math.exp(-a * at), _decayed(b * at)
                peak = max(peak, _flow(x, a, b, c, g, held, load, at, E_a, E_b))
                held = values[slot]
                peak = max(peak, _flow(x, a, b, c, g, held, load, h - at, E_ah / E_a, E_bh / E_b))
            else:
                peak = max(peak, _flow(x, a, b, c, g, held, load, h, E_ah, E_bh))
        elif k >= behind and came[oldest]:
            peak = max(peak, _flow(x, a, b, c, g, held, load, offset, E_ao, E_bo))
            held = values[oldest]
            peak = max(peak, _flow(x, a, b, c, g, held, load, h - offset, E_ah / E_ao, E_bh / E_bo))
        else:
            peak = max(peak, _flow(x, a, b, c, g, held, load, h, E_ah, E_bh))
        if not peak < limit:
            return np.inf
    return peak


@_parallel
def _run_all(
    seed: np.uint64, plant: Array, width: float, K: Array, settings: Array, kind: int, losses_max: int,
    behind: int, steps: int, limit: float, peaks: Array,
) -> None:  # fmt: skip
    for number in numba.prange(len(peaks)):
        start = _mixed(_mixed(seed) + np.uint64(number))
        peaks[number] = _run(start, plant, width, K, settings, kind, losses_max, behind, steps, limit)
