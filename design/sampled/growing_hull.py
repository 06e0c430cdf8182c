"""A convex hull to which points are added, and the question whether a point is near to it."""

import math

import numpy as np
from scipy.optimize import nnls

from servobench.design.delay.delay_loop import Array

_NEAREST = 48
"""Points of the hull that are tried first as corners of the hull around a candidate."""
_TOUCHED = 4
"""Times that the ellipsoid is touched anew on the way from the hull to a candidate."""


class GrowingHull:
    """Hull of points and of an ellipsoid |W p| <= size around 0; ``count``: the number of points."""

    def __init__(self, points: Array, W: Array, size: float) -> None:
        self._points = points.copy()
        self.count = len(points)
        self._W, self._size = W, size
        self._inverse = np.linalg.inv(W.T @ W)

    def add(self, point: Array) -> None:
        """Add a point."""
        if self.count == len(self._points):
            room = np.zeros((max(64, self.count), len(point)))
            self._points = np.vstack([self._points, room])
        self._points[self.count] = point
        self.count += 1

    def is_near(self, point: Array, distance: float) -> bool:
        """Return True if some point of the hull is found within ``distance`` of ``point``."""
        points = np.vstack([self._points[: self.count], self._towards(point)])
        apart = points - point
        far = np.linalg.norm(apart, axis=1)
        if np.min(far) <= distance:
            return True
        if len(points) > _NEAREST:
            nearest = np.argpartition(far, _NEAREST)[:_NEAREST]
            towards = np.argpartition(apart @ -point, _NEAREST)[:_NEAREST]
            apart = apart[np.union1d(nearest, towards)]
        for _ in range(_TOUCHED):
            left = _nearest(apart)
            if left is None or np.linalg.norm(left) <= distance:
                return left is not None
            if self._size <= 0.0:
                return False
            # the ellipsoid's point farthest towards what is left
            apart = np.vstack([apart, self._farthest(-left) - point])
        return False

    def _towards(self, point: Array) -> Array:
        """Return the ellipsoid's boundary on the way to ``point``."""
        return np.asarray(point * (self._size / max(float(np.linalg.norm(self._W @ point)), 1e-300)))

    def _farthest(self, direction: Array) -> Array:
        """Return the ellipsoid's point farthest in ``direction``."""
        turned = self._inverse @ direction
        return np.asarray(turned * (self._size / math.sqrt(max(float(direction @ turned), 1e-300))))


def _nearest(points: Array) -> Array | None:
    """Return a nearly nearest point of the hull of ``points`` to 0: never nearer than the hull."""
    weight = float(np.linalg.norm(points, axis=1).max())
    whole = np.vstack([points.T, np.full(len(points), weight)])
    shares, _ = nnls(whole, np.append(np.zeros(points.shape[1]), weight))
    total = float(shares.sum())
    return np.asarray(shares @ points) / total if total > 0.0 else None
