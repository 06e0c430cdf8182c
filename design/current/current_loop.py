"""A current controller in a drive: sampled at the inner rate, its voltage put out a computation delay later.

Two ways to a sampled controller: the continuous one by Tustin's rule, prewarped at the crossover, or a
design for the sampled plant itself, with its hold and delay, in the bilinear plane (s = 2/T (z-1)/(z+1)).

The two sampled current loops of a PMSM together, at a constant speed, with their coupling.

Within a period the inverter's voltage stands still in the stator's frame, so it turns backwards in the
rotor's. It is computed from the samples at k, put out from k + delay on, and turned forward by ``advance``
periods of rotation (Park's angle advance). Decoupling adds -w L_q i_q and +w L_d i_d of the drive's own
parameters to the controllers' voltages; the magnets' voltage is a disturbance and moves no pole.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from servobench.design.errors import InfeasibleDesign
from servobench.design.hinf.margins import Margins, margins
from servobench.design.hinf.mixed_sensitivity import GeneralisedPlant, Weights, mixed_sensitivity
from servobench.design.hinf.synthesis import gamma_min, synthesise, verified_norm
from servobench.design.motor import PmsmParameters
from servobench.design.statespace import (
    Array,
    StateSpace,
    append,
    balanced,
    connect,
    from_bilinear,
    series,
    state_space,
    to_bilinear,
    tustin,
)

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


_J = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Decoupling:
    """The drive's model: the inductances it decouples with, H, and its angle advance, periods."""

    inductance_d_h: float
    inductance_q_h: float
    advance_periods: float


def nominal_decoupling(motor: PmsmParameters, delay_samples: int) -> Decoupling:
    """Return right parameters, and the angle at the middle of the period in which the voltage acts."""
    return Decoupling(motor.inductance_d_h, motor.inductance_q_h, delay_samples + 0.5)


def rotation(angle_rad: float) -> Array:
    """Return the (2, 2) rotation by ``angle_rad``."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def dq_matrix(motor: PmsmParameters, electrical_rad_s: float) -> tuple[Array, Array]:
    """Return A and B of d[i_d, i_q]/dt at a constant electrical speed; voltages in the rotor's frame."""
    R, Ld, Lq = motor.resistance_ohm, motor.inductance_d_h, motor.inductance_q_h
    A = np.array([[-R / Ld, electrical_rad_s * Lq / Ld], [-electrical_rad_s * Ld / Lq, -R / Lq]])
    return A, np.diag([1.0 / Ld, 1.0 / Lq])


def closed_loop_matrix(
    motor: PmsmParameters,
    K_d: StateSpace,
    K_q: StateSpace,
    speed_rad_s: float,
    decoupling: Decoupling | None,
    delay_samples: int = 1,
) -> Array:
    """Return the transition matrix over one period of [i, waiting voltages, K_d's and K_q's states].

    ``speed_rad_s`` is mechanical; ``decoupling`` None: neither decoupling nor angle advance.
    """
    K = append(K_d, K_q)
    period_s = K.period_s
    if period_s is None:
        raise ValueError("sampled controllers are expected: discretise them first")
    electrical = motor.pole_pairs * speed_rad_s
    A, B = dq_matrix(motor, electrical)
    joint = np.block([[A, B], [np.zeros((2, 2)), -electrical * _J]])
    grown = scipy.linalg.expm(joint * period_s)
    ahead = decoupling.advance_periods if decoupling else 0.0
    turned = rotation((ahead - delay_samples) * electrical * period_s)
    Phi, Gamma = grown[:2, :2], grown[:2, 2:] @ turned
    cross = np.zeros((2, 2))
    if decoupling:
        cross = electrical * np.array([[0.0, -decoupling.inductance_q_h], [decoupling.inductance_d_h, 0.0]])
    voltage_of_current = cross - K.D
    waiting = 2 * delay_samples
    n = 2 + waiting + K.order
    M = np.zeros((n, n))
    M[:2, :2] = Phi
    M[2 + waiting :, :2] = -K.B
    M[2 + waiting :, 2 + waiting :] = K.A
    if delay_samples == 0:
        M[:2, :2] += Gamma @ voltage_of_current
        M[:2, 2:] = Gamma @ K.C
        return M
    M[:2, 2:4] = Gamma
    M[2:waiting, 4 : 2 + waiting] = np.eye(waiting - 2)
    M[waiting : 2 + waiting, :2] = voltage_of_current
    M[waiting : 2 + waiting, 2 + waiting :] = K.C
    return M


def lowest_coupled_rate_hz(
    motor: PmsmParameters,
    K_d: StateSpace,
    K_q: StateSpace,
    crossovers_rad_s: tuple[float, float],
    speed_max_rad_s: float,
    delay_samples: int,
) -> float | None:
    """Return the lowest rate, to 1 %, at and above which Tustin's ``K_d`` and ``K_q`` are stable up to that
    speed.

    With right decoupling and angle advance, seen at six speeds. None: not even at ``RATE_MAX_HZ``.
    """
    speeds = np.linspace(0.0, speed_max_rad_s, 6)
    decoupling = nominal_decoupling(motor, delay_samples)

    def holds(rate_hz: float) -> bool:
        if rate_hz <= 1.05 * max(crossovers_rad_s) / np.pi:
            return False
        d, q = (tustin(K, rate_hz, at) for K, at in zip((K_d, K_q), crossovers_rad_s, strict=True))
        return bool(spectral_radius(motor, d, q, speeds, decoupling, delay_samples).max() < 1.0)

    return lowest_rate(holds, 0.01)


def spectral_radius(
    motor: PmsmParameters,
    K_d: StateSpace,
    K_q: StateSpace,
    speeds_rad_s: Array,
    decoupling: Decoupling | None,
    delay_samples: int = 1,
) -> Array:
    """Return the (k,) largest pole magnitude of the coupled loops at the k mechanical speeds, rad/s."""
    radii = [
        np.abs(
            np.linalg.eigvals(closed_loop_matrix(motor, K_d, K_q, float(speed), decoupling, delay_samples))
        ).max()
        for speed in speeds_rad_s
    ]
    return np.array(radii)
