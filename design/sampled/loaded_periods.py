"""Periods of a loop under a load, which is one more entry, the last, of their state."""

import math
from collections.abc import Sequence

import numpy as np
import scipy.linalg

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.held_loop import HeldInput, Jump, Operation


class LoadedPeriods:
    """Periods of ``loop`` under a load; errors at ``within`` instants of each."""

    def __init__(self, loop: HeldInput, period_s: float, within: int) -> None:
        self._loop, self._period_s, self._within = loop, period_s, within
        model, n = self._loop.model, len(self._loop.model.A)
        self._rates = np.zeros((n + 2, n + 2))  # of [x, u, load]
        self._rates[:n, :n], self._rates[:n, n], self._rates[:n, n + 1] = model.A, model.B1, model.B2
        self._places = [*range(n + 1), self._loop.size]
        self._look = np.zeros(self._loop.size + 1)
        self._look[:n] = math.copysign(1.0, model.C @ model.B2) * model.C
        self._flows: dict[float, Array] = {}

    def begin(self) -> tuple[Array, Array]:
        """Return the state a period after the load came, from rest, and the errors until then."""
        whole, looks = self.period([])
        return whole[:, -1], looks[:, -1]

    def period(self, chain: Sequence[Operation]) -> tuple[Array, Array]:
        """Return a period's map (N, N), and the errors within it (within, N)."""
        at_s, total = 0.0, np.eye(len(self._look))
        looks: list[Array] = []
        whole_s, tick_s = self._period_s * (1.0 + 1e-9), self._period_s / self._within
        for operation in (*chain, None):
            if isinstance(operation, Jump):
                total[:-1] = operation.J @ total[:-1]
                continue
            length_s = self._period_s - at_s if operation is None else operation.length_s
            while (next_s := tick_s * (len(looks) + 1)) <= min(at_s + length_s, whole_s):
                looks.append(self._look @ self.flow(next_s - at_s) @ total)
            total, at_s = self.flow(length_s) @ total, at_s + length_s
        looks += [self._look @ total] * (self._within - len(looks))
        return total, np.array(looks)

    def flow(self, length_s: float) -> Array:
        """Return what passes in ``length_s``, (N, N)."""
        known = self._flows.get(length_s)
        if known is None:
            known = np.eye(len(self._look))
            known[np.ix_(self._places, self._places)] = scipy.linalg.expm(self._rates * length_s)
            self._flows[length_s] = known
        return known
