"""Loops with delay as something simpler sees them: a spectrum by collocation, a dense grid of frequencies."""

import numpy as np

from servobench.design.delay.delay_loop import Array, DelayLoop


def generator_abscissa(loop: DelayLoop, nodes: int = 40) -> float:
    """Largest real part, 1/s, of the eigenvalues of the infinitesimal generator, by Chebyshev collocation.

    The state on [-delay, 0] at Chebyshev points; x(-delay) is the last block, the first row is the
    equation itself (Breda, Maset, Vermiglio, SIAM J. Sci. Comput. 27, 2005).
    """
    n = len(loop.A)
    k = np.arange(nodes + 1)
    points = np.cos(np.pi * k / nodes)
    weights = np.where((k == 0) | (k == nodes), 2.0, 1.0) * (-1.0) ** k
    gaps = points[:, None] - points[None, :] + np.eye(nodes + 1)
    D = np.outer(weights, 1.0 / weights) / gaps
    D -= np.diag(D.sum(axis=1))
    total = np.kron(2.0 / loop.delay_s * D, np.eye(n))
    total[:n] = 0.0
    total[:n, :n] = loop.A
    total[:n, -n:] = loop.BK
    return float(np.max(np.linalg.eigvals(total).real))


def magnitudes(loop: DelayLoop, w: Array) -> Array:
    """|C (jw - A - B K e^{-jw delay})^-1 E| by solving at each frequency."""
    n = len(loop.A)
    matrices = (
        1j * w[:, None, None] * np.eye(n) - loop.A - loop.BK * np.exp(-1j * w * loop.delay_s)[:, None, None]
    )
    right = np.broadcast_to(loop.E[:, None].astype(complex), (len(w), n, 1))
    return np.asarray(np.abs(loop.C @ np.linalg.solve(matrices, right))[:, 0])


def random_loop(seed: int) -> DelayLoop:
    """Two or three states, rates from 1 to 1000 rad/s, a delay of the same order."""
    draw = np.random.default_rng(seed)
    n = int(draw.integers(1, 4))
    rate = 10.0 ** draw.uniform(0.0, 3.0)
    A = rate * (draw.normal(size=(n, n)) - 1.5 * np.eye(n))
    B, E, C = (draw.normal(size=n) for _ in range(3))
    K = rate * draw.normal(size=n)
    return DelayLoop(A, B, K, E, C, float(draw.uniform(0.05, 1.5)) / rate)
