"""Seeded plants for the tests of the synthesis."""

import numpy as np

from design.hinf_plant import GeneralisedPlant
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
