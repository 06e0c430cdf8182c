"""A load step of 1 N m on a sampled loop: its begin, its rest, and the error within a period.

There is one state at rest under the load, whatever is lost; d is the departure from it. The load comes within
the period before the first sample.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.errors import NoSolution
from servobench.design.sampled.falling_norms import FallingNorms, Norms
from servobench.design.sampled.held_loop import HeldInput, Operation
from servobench.design.sampled.loaded_periods import LoadedPeriods
from servobench.design.sampled.peak_steps import error_curvature, start_curvature
from servobench.design.sampled.peak_tree import Leaves

_WITHIN = 128
"""Instants of a period at which the error is evaluated."""
_START_PARTS = 64
"""Parts of the period in which the load may come."""
_ALIKE = 1e-6
"""Relative: how well the state at rest has to stay in every step."""


class PeriodMaps(NamedTuple):
    """A period, on d."""

    M: Array
    """(k, k)."""
    looks: Array
    """(W, k): errors within it."""
    inputs: Array
    """(2, k): what acts on the plant at its begin and at its end."""


class SteppedLoad:
    """The step on ``loop``, whose period without losses is ``usual``."""

    def __init__(self, loop: HeldInput, period_s: float, usual: Sequence[Operation]) -> None:
        self._loop = loop
        self._loaded = LoadedPeriods(loop, period_s, _WITHIN)
        whole, looks = self._loaded.period(usual)
        size, model, n = len(whole) - 1, loop.model, len(loop.model.A)
        rest = np.linalg.lstsq(np.eye(size) - whole[:-1, :-1], whole[:-1, -1], rcond=None)[0]
        self._rest = np.append(rest, 1.0)
        self.rest_looks = looks @ self._rest
        """(W,): errors at rest."""
        self.error_at_rest = float(np.abs(self.rest_looks).max())
        lengths_s = period_s * np.arange(_START_PARTS + 1) / _START_PARTS
        self.starts = np.array([self._loaded.flow(length_s)[:-1, -1] for length_s in lengths_s]) - rest
        """(N, k): d at the first sample, the load having come 0 .. 1 periods before."""
        curved = start_curvature(model, period_s)
        self._bend = np.zeros(size)
        self._bend[:n] = (period_s / _START_PARTS) ** 2 / 8.0 * curved
        begun = (period_s / _WITHIN) ** 2 / 8.0 * float(np.abs(model.C) @ curved)
        first = max(float(np.abs(self._loaded.begin()[1]).max()), self.error_at_rest)
        self.known = first, first + begun
        """An error that is reached before the first sample or in the end, and a bound of these."""
        of_state, of_input, _ = error_curvature(model, period_s)
        share = (period_s / _WITHIN) ** 2 / 8.0
        self._of_state, self._of_input = share * of_state, share * of_input

    def maps(self, chain: Sequence[Operation]) -> PeriodMaps:
        """Return those of a period. Raises NoSolution where it moves the state at rest."""
        whole, looks = self._loaded.period(chain)
        moved = whole[:-1] @ self._rest - self._rest[:-1]
        if np.abs(moved).max() > _ALIKE * np.abs(self._rest).max():
            raise NoSolution("certificate of the peak", "what is lost moves the state at rest")
        place = len(self._loop.model.A)
        held = np.array([np.eye(len(self._rest) - 1)[place], self._loop.transition(chain)[place]])
        return PeriodMaps(whole[:-1, :-1], looks[:, :-1], held)

    def begun(self, node: int, norms: FallingNorms, memory: Array) -> Leaves:
        """Return the leaves at ``node``, one for each begin of the load and row of ``memory`` (N, m)."""
        count, parts = len(memory), len(self.starts)
        bend = float(np.linalg.norm(np.abs(norms.T[node]) @ self._bend))
        return Leaves(
            np.full(count * parts, node),
            np.tile(self.starts, (count, 1)),
            np.full(count * parts, bend),
            np.repeat(memory, parts, axis=0),
        )

    def errors(self, d: Array, seen: Array, held: Array) -> tuple[Array, Array]:
        """Return (N,) the largest errors at the instants, and how far they may be exceeded between these.

        ``d`` (N, k) at the period's begin, ``seen`` (N, W) its errors, ``held`` (N, 2) its inputs.
        """
        n = len(self._of_state)
        between = np.abs(d[:, :n]) @ self._of_state + self._of_input * np.abs(held).max(axis=1)
        return np.abs(seen + self.rest_looks).max(axis=1), between


class NormedWalks:
    """Walks of the departure ``d`` from rest, in ``norms`` that no period enlarges."""

    def __init__(self, norms: Norms, step: SteppedLoad) -> None:
        self._norms, self._step = norms, step

    def bounds(self, leaves: Leaves) -> Array:
        """Return (N,): what no error behind each leaf exceeds."""
        sizes = self._norms.sizes(leaves.node, leaves.d) + leaves.radius
        return np.asarray(self._step.error_at_rest + sizes)

    def refine(self, leaves: Leaves) -> None:
        """Sharpen the bounds for some leaves."""
        self._norms.refine(leaves.node, leaves.d)
