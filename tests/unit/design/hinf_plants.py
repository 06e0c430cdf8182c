"""Seeded plants for the tests of the synthesis."""

import numpy as np
import scipy.stats

from design.hinf.plant import GeneralisedPlant
from design.statespace import StateSpace


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
