"""Time responses of a loop with one constant delay, by the method of steps with collocation.

On an interval of one delay the delayed state is known from the interval before, so the loop is an
ordinary linear system there. Each interval is cut into pieces on which the solution is a polynomial
through Radau points (order 2 x points - 1, last point at the end); one matrix then maps an interval
to the next. A step of the disturbance breaks derivatives only at whole delays, where the pieces end.
"""

import math
from dataclasses import dataclass

import numpy as np

from servobench.design.delay.delay_loop import Array, DelayLoop
from servobench.design.delay.delay_norm import is_stable

_POINTS = 8
"""Order 15: on a piece of the length below an error of 3e-11 of the peak, beside 1e-8 with six points."""
_FINE = 16
"""Points to a piece at which a response is given."""
_PIECE_TURN = 1.5
"""A piece is cut until the fastest rate times its length is at most this."""
_INTERVALS_MAX = 1_000_000
"""0.9999 of the largest stable delay needs 250 000, and a minute. A slower decay has its peak in the first of
them."""
_SETTLED = 1e-7
"""Distance from the final value, relative to the peak, at which the search for a higher one ends."""


@dataclass(frozen=True, slots=True, eq=False)
class DelayResponse:
    """Instants, (m,) s, and states there, (m, n)."""

    time_s: Array
    x: Array


class DelayedSteps:
    """Maps one interval of ``loop`` to the next. Without delay the interval is a few of the fastest rate."""

    def __init__(self, loop: DelayLoop) -> None:
        self._n = len(loop.A)
        rate = float(np.max(np.abs(np.linalg.eigvals(loop.A))) + np.max(np.abs(np.linalg.eigvals(loop.BK))))
        closed = loop.A + loop.BK
        if loop.delay_s == 0.0:
            rate = float(np.max(np.abs(np.linalg.eigvals(closed))))
        self.interval_s = loop.delay_s if loop.delay_s > 0.0 else 4.0 * _PIECE_TURN / max(rate, 1e-12)
        pieces = max(1, math.ceil(self.interval_s * rate / _PIECE_TURN))
        self._length_s = self.interval_s / pieces
        self._pieces = pieces
        points, integral = _radau(_POINTS)
        A, BK = (loop.A, loop.BK) if loop.delay_s > 0.0 else (closed, np.zeros_like(closed))
        identity = np.eye(self._n)
        inverse = np.linalg.inv(np.eye(_POINTS * self._n) - self._length_s * np.kron(integral, A))
        self._from_start = inverse @ np.kron(np.ones((_POINTS, 1)), identity)
        self._from_delayed = inverse @ (self._length_s * np.kron(integral, BK))
        self._from_load = inverse @ (self._length_s * np.kron(integral.sum(axis=1)[:, None], loop.E[:, None]))
        self._fine = _interpolation(np.append(0.0, points), np.arange(_FINE) / _FINE)

    def start(self) -> Array:
        """Return the interval before the first one of a loop at rest: (pieces, points, n)."""
        return np.zeros((self._pieces, _POINTS, self._n))

    def next(self, x: Array, before: Array, load: float) -> tuple[Array, Array]:
        """Return the next interval and its end, from the state (n,) at its begin and the interval before."""
        after = np.empty_like(before)
        for number in range(self._pieces):
            flat = (
                self._from_start @ x
                + self._from_delayed @ before[number].ravel()
                + self._from_load[:, 0] * load
            )
            after[number] = flat.reshape(_POINTS, self._n)
            x = after[number, -1]
        return after, x

    def fine(self, x: Array, interval: Array) -> Array:
        """Return states at equal steps from the interval's begin, where the state is ``x``, up to before its
        end."""
        starts = np.vstack([x[None], interval[:-1, -1]])
        through = np.concatenate([starts[:, None], interval], axis=1)
        return np.asarray(np.einsum("fp,kpn->kfn", self._fine, through).reshape(-1, self._n))

    @property
    def step_s(self) -> float:
        """Step between two states of :meth:`fine`."""
        return self._length_s / _FINE


def respond(loop: DelayLoop, duration_s: float, load: float = 0.0, x0: Array | None = None) -> DelayResponse:
    """Simulate from ``x0`` (default: rest) at t = 0, with no history before it, under a constant
    disturbance."""
    steps = DelayedSteps(loop)
    x = np.zeros(len(loop.A)) if x0 is None else np.asarray(x0, dtype=float)
    interval = steps.start()
    parts = []
    for _ in range(max(1, math.ceil(duration_s / steps.interval_s * (1.0 - 1e-12)))):
        begin = x
        interval, x = steps.next(x, interval, load)
        parts.append(steps.fine(begin, interval))
    states = np.vstack(parts)
    kept = math.floor(duration_s / steps.step_s * (1.0 + 1e-12)) + 1
    return DelayResponse(np.asarray(np.arange(len(states))[:kept] * steps.step_s), np.asarray(states[:kept]))


def step_peak(loop: DelayLoop) -> float:
    """Return the largest |z| after a unit step of the disturbance at rest; inf if the loop is unstable."""
    if not is_stable(loop):
        return math.inf
    steps = DelayedSteps(loop)
    x, interval = np.zeros(len(loop.A)), steps.start()
    rest = np.linalg.solve(loop.A + loop.BK, -loop.E)
    peak = abs(float(loop.C @ rest))
    for _ in range(_INTERVALS_MAX):
        begin = x
        interval, x = steps.next(x, interval, 1.0)
        z = np.append(steps.fine(begin, interval), x[None], axis=0) @ loop.C
        peak = max(peak, _summit(np.abs(z)))
        away = np.abs((interval - rest) @ loop.C)
        if peak > 0.0 and np.max(away) < _SETTLED * peak and np.max(np.abs(interval - rest)) < 1e-3 * peak:
            break
    return peak


def _summit(z: Array) -> float:
    """Return the largest value, by a parabola through its neighbours."""
    top = int(np.argmax(z))
    if top in (0, len(z) - 1):
        return float(z[top])
    left, middle, right = z[top - 1 : top + 2]
    bend = left - 2.0 * middle + right
    return float(middle - (right - left) ** 2 / (8.0 * bend)) if bend < 0.0 else float(middle)


def _radau(points: int) -> tuple[Array, Array]:
    """Return right Radau points in (0, 1] and the integrals from 0 to each of the polynomials through
    them."""
    last = np.zeros(points + 1)
    last[points - 1], last[points] = 1.0, -1.0
    roots = np.sort(np.polynomial.legendre.legroots(last).real)  # numpy 2.5 tells them as complex
    roots[-1] = 1.0
    return 0.5 * (roots + 1.0), integrals_to(roots)


def integrals_to(nodes: Array) -> Array:
    """Return the (n, n) map from values at ``nodes`` ([-1, 1] moved to [0, 1]) to the integrals from 0 to
    each."""
    V = np.polynomial.legendre.legvander(nodes, len(nodes) - 1)
    integrals = np.stack(
        [
            np.polynomial.legendre.legval(nodes, np.polynomial.legendre.legint(row, lbnd=-1.0))
            for row in np.eye(len(nodes))
        ],
        axis=1,
    )
    return np.asarray(0.5 * integrals @ np.linalg.inv(V))


def _interpolation(nodes: Array, at: Array) -> Array:
    """Return (len(at), len(nodes)): values at ``at`` of the polynomial through values at ``nodes``."""
    V = np.polynomial.legendre.legvander(2.0 * nodes - 1.0, len(nodes) - 1)
    return np.asarray(np.polynomial.legendre.legvander(2.0 * at - 1.0, len(nodes) - 1) @ np.linalg.inv(V))
