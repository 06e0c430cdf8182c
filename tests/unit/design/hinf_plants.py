"""Seeded plants for the tests of the synthesis."""

import numpy as np
import scipy.stats

from servobench.design.hinf.mixed_sensitivity import GeneralisedPlant
from servobench.design.statespace import StateSpace, to_bilinear


def random_plant(seed: int) -> GeneralisedPlant:
    """A generalised plant with D11 and D22, stable or not, SISO or MIMO."""
    draw = np.random.default_rng(seed)
    n, m1 = int(draw.integers(1, 7)), int(draw.integers(1, 4))
    m2, p2 = int(draw.integers(1, m1 + 1)), int(draw.integers(1, m1 + 1))
    p1 = int(draw.integers(m2, 5))
    A = draw.normal(size=(n, n)) * 10.0 ** draw.uniform(-1.0, 1.0)
    B, C = draw.normal(size=(n, m1 + m2)), draw.normal(size=(p1 + p2, n))
    D = 0.5 * draw.normal(size=(p1 + p2, m1 + m2))
    return GeneralisedPlant(StateSpace(A, B, C, D), m2, p2)


def badly_scaled(seed: int) -> GeneralisedPlant:
    """:func:`random_plant` in other units of its states and of time: in exact arithmetic the same."""
    plant, draw = random_plant(seed), np.random.default_rng(seed + 9999)
    s = plant.system
    units = 10.0 ** draw.uniform(-4.0, 4.0, s.order)
    rate = 10.0 ** draw.uniform(-2.0, 6.0)
    scaled = StateSpace(s.A * units / units[:, None] * rate, s.B / units[:, None] * rate, s.C * units, s.D)
    return GeneralisedPlant(scaled, plant.controls, plant.measurements)


def stiff_plant(seed: int) -> GeneralisedPlant:
    """Modes from 1e-2 to 3e6 rad/s behind an orthogonal change of states, which no scaling takes back."""
    draw = np.random.default_rng(seed)
    n, m2, p2 = int(draw.integers(2, 6)), int(draw.integers(1, 3)), int(draw.integers(1, 3))
    rates = 10.0 ** draw.uniform(-2.0, 6.5, n)
    turn = scipy.stats.ortho_group.rvs(n, random_state=draw) if n > 1 else np.eye(1)
    size = np.sqrt(rates)[:, None]
    B = turn @ (draw.normal(size=(n, 2 + m2)) * size)
    C = (draw.normal(size=(m2 + 1 + p2, n)) * size.T) @ turn.T
    D = 0.5 * draw.normal(size=(m2 + 1 + p2, 2 + m2))
    return GeneralisedPlant(StateSpace(-(turn * rates) @ turn.T, B, C, D), m2, p2)


def with_weak_control(plant: GeneralisedPlant, factor: float) -> GeneralisedPlant:
    """``plant`` with a D12 that nearly vanishes."""
    s, D = plant.system, plant.system.D.copy()
    D[plant.z, plant.u] *= factor
    return GeneralisedPlant(StateSpace(s.A, s.B, s.C, D), plant.controls, plant.measurements)


def with_as_many_errors_as_controls(seed: int) -> GeneralisedPlant:
    """:func:`random_plant` with z of the size of u and w of that of y.

    X and Y are nothing but for the zeros of P12 and P21 in the right half plane. Those of an even ``seed``
    have none there, and so gamma no lower limit.
    """
    plant, draw = random_plant(seed), np.random.default_rng(seed + 4444)
    n, m2, p2 = plant.system.order, plant.controls, plant.measurements
    A, B2, C2 = plant.system.A, plant.system.B[:, plant.u], plant.system.C[plant.y]
    B1, C1, D = draw.normal(size=(n, p2)), draw.normal(size=(m2, n)), draw.normal(size=(m2 + p2, p2 + m2))
    D[:m2, p2:], D[m2:, :p2] = 2.0 * np.eye(m2), 2.0 * np.eye(p2)
    if seed % 2 == 0:  # A - B2 D12^-1 C1 and A - B1 D21^-1 C2 are moved to the left together
        reach = [np.linalg.eigvals(M).real.max() for M in (A - B2 @ C1 / 2.0, A - B1 @ C2 / 2.0)]
        A = A - (max(*reach, 0.0) + 0.1) * np.eye(n)
    return GeneralisedPlant(StateSpace(A, np.hstack([B1, B2]), np.vstack([C1, C2]), D), m2, p2)


def sampled_plant(seed: int) -> GeneralisedPlant:
    """:func:`random_plant` read as one of 1 kHz, its modes within 0.3 to 1.2, in the bilinear plane."""
    plant, draw = random_plant(seed), np.random.default_rng(seed + 77)
    s = plant.system
    A = s.A / np.abs(np.linalg.eigvals(s.A)).max() * draw.uniform(0.3, 1.2)
    return GeneralisedPlant(
        to_bilinear(StateSpace(A, s.B, s.C, s.D, 1e-3)), plant.controls, plant.measurements
    )
