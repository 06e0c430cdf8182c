"""The worst disturbance's gain over a stretch of time, as a map of quadratic functions.

Over a stretch from xi to xi+ the largest of

    integral of (z^2 - d^2)  +  xi+' P xi+          over all disturbances d

is again a quadratic function of xi, xi' S xi, as long as it is finite:

    S = Q + Phi' P (I - W P)^{-1} Phi          I - W P with positive eigenvalues

Q is the stretch's own contribution, Phi the map of xi, W the disturbance's reach. For a flow the three are
blocks of the exponential of the Hamiltonian matrix; one after the other they compose by Redheffer's star
product. (Basar and Bernhard, H-infinity Optimal Control, 1995, ch. 4 and 8.)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from servobench.design.delay.delay_loop import Array
from servobench.design.statespace import balancing_scales

_PARTS = ("Phi", "W", "Q", "bounded")
_TURN = 0.5
"""Norm of F, in balanced coordinates, times the length of the piece whose exponential is taken."""


@dataclass(frozen=True, slots=True, eq=False)
class ValueMap:
    """Phi, W and Q above, (..., n, n); ``bounded``, (...): True where the largest is finite for P = 0."""

    Phi: Array
    W: Array
    Q: Array
    bounded: np.ndarray

    def __getitem__(self, part: Any) -> "ValueMap":
        return ValueMap(self.Phi[part], self.W[part], self.Q[part], self.bounded[part])

    def then(self, following: "ValueMap") -> "ValueMap":
        """Return this stretch followed by ``following``."""
        n = self.Phi.shape[-1]
        bounded = self.bounded & following.bounded & _below_one(self.W, following.Q)
        inner = np.where(bounded[..., None, None], np.eye(n) - self.W @ following.Q, np.eye(n))
        both = [np.broadcast_to(part, inner.shape) for part in (self.Phi, self.W)]
        turned = np.linalg.solve(inner, np.concatenate(both, axis=-1))
        Phi1, W1, Phi2 = turned[..., :n], turned[..., n:], following.Phi
        Q = self.Q + _t(self.Phi) @ following.Q @ Phi1
        W = following.W + Phi2 @ W1 @ _t(Phi2)
        # what is not bounded stays so, whatever its matrices are: zeros do not overflow
        keep = bounded[..., None, None]
        return ValueMap(
            np.where(keep, Phi2 @ Phi1, 0.0),
            np.where(keep, 0.5 * (W + _t(W)), 0.0),
            np.where(keep, 0.5 * (Q + _t(Q)), 0.0),
            bounded,
        )

    def reshaped(self, shape: tuple[int, ...]) -> "ValueMap":
        """Return the same maps in another order of axes."""
        bounded = self.bounded.reshape(shape)
        full = (*bounded.shape, *self.Phi.shape[-2:])
        return ValueMap(self.Phi.reshape(full), self.W.reshape(full), self.Q.reshape(full), bounded)

    def then_jump(self, J: Array) -> "ValueMap":
        """Return this stretch, and at its end xi+ = J xi."""
        return ValueMap(J @ self.Phi, J @ self.W @ _t(J), self.Q, self.bounded)

    def after_jump(self, J: Array) -> "ValueMap":
        """Return xi+ = J xi, and then this stretch."""
        return ValueMap(self.Phi @ J, self.W, _t(J) @ self.Q @ J, self.bounded)

    def of(self, P: Array) -> tuple[Array, np.ndarray]:
        """Return S for P, and where it is finite."""
        n = self.Phi.shape[-1]
        finite = self.bounded & _below_one(self.W, P)
        inner = np.where(finite[..., None, None], np.eye(n) - self.W @ P, np.eye(n))
        S = self.Q + _t(self.Phi) @ P @ np.linalg.solve(inner, self.Phi)
        return 0.5 * (S + _t(S)), finite


def largest_product(W: Array, Q: Array) -> Array:
    """Return the largest eigenvalue of W Q, both (..., n, n) and positive semidefinite."""
    return np.asarray(np.max(np.linalg.eigvals(W @ Q).real, axis=-1))


def _below_one(W: Array, Q: Array) -> np.ndarray:
    """Return True where the largest eigenvalue of W Q is below 1: decided by the trace, the sum of all, if
    possible."""
    trace = np.einsum("...ij,...ji->...", W, Q)
    below = np.asarray(trace < 1.0)
    open_ = (trace >= 1.0) & (trace < W.shape[-1])
    if np.any(open_):
        W, Q = (np.broadcast_to(part, (*open_.shape, *part.shape[-2:])) for part in (W, Q))
        below[open_] = largest_product(W[open_], Q[open_]) < 1.0
    return below


def nothing(shape: tuple[int, ...], n: int) -> ValueMap:
    """Return maps of no time at all, in the given shape."""
    zero = np.zeros((*shape, n, n))
    return ValueMap(zero + np.eye(n), zero, zero, np.ones(shape, dtype=bool))


def stacked(maps: Sequence[ValueMap]) -> ValueMap:
    """Stack all of them along a first axis."""
    return ValueMap(*(np.stack([getattr(each, part) for each in maps]) for part in _PARTS))


def flows(F: Array, E: Array, C: Array, gains: ArrayLike, lengths_s: Array) -> ValueMap:
    """Return xi' = F xi + E d, z = C xi over each of ``lengths_s`` (N,), d measured so that each gain counts
    as 1.

    F (n, n); E and C (n,); ``gains``: one, or (G,) for maps (N, G, n, n).
    """
    n = len(F)
    level = np.asarray(gains, dtype=float)
    H = np.zeros((*level.shape, 2 * n, 2 * n))
    H[..., :n, :n], H[..., n:, n:], H[..., n:, :n] = F, -F.T, -np.outer(C, C)
    H[..., :n, n:] = np.outer(E, E) / level[..., None, None] ** 2
    scale = balancing_scales(np.block([[F, E[:, None]], [C[None, :], np.zeros((1, 1))]]))[:n]
    rate = float(np.linalg.norm(F * scale / scale[:, None], 2)) / _TURN
    # |z| is at most |C| e^{|F| t} |E| times the integral of |d|: the gain of a piece must be below 1/2
    own = float(np.linalg.norm(C * scale) * np.linalg.norm(E / scale)) / float(np.min(level))
    rate = max(rate, 2.0 * math.exp(_TURN) * own)
    longest = float(np.max(lengths_s, initial=0.0))
    halvings = max(0, math.ceil(math.log2(max(longest * rate, 1.0))))
    whole = expm(lengths_s.reshape(-1, *[1] * H.ndim) / 2.0**halvings * H)
    G12, G21, G22 = whole[..., :n, n:], whole[..., n:, :n], whole[..., n:, n:]
    inverse = np.linalg.inv(G22)
    W, Q = G12 @ inverse, -inverse @ G21
    bounded = np.ones(whole.shape[:-2], dtype=bool)
    flow = ValueMap(_t(inverse), 0.5 * (W + _t(W)), 0.5 * (Q + _t(Q)), bounded)
    for _ in range(halvings):
        flow = flow.then(flow)
    return flow


def _t(matrix: Array) -> Array:
    return np.swapaxes(matrix, -1, -2)
