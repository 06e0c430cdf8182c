"""A load step of 1 N m on a sampled loop: its begin, its rest, and the error within a period.

There is one state at rest under the load, whatever is lost and whatever the inertia; d is the departure from
it. The load comes within the period before the first sample. The inertia is one of a range: d is a polynomial
in u, -1 <= u <= 1, its inverse being (middle + u half) times that of the model.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from servobench.design.delay.delay_loop import Array, SpeedModel
from servobench.design.errors import NoSolution
from servobench.design.sampled.falling_norms import Elsewhere, FallingNorms, NormedEdge, Norms
from servobench.design.sampled.held_loop import HeldInput, Jump, LoadedPeriods, Operation
from servobench.design.sampled.peak_steps import Leaves, covered, error_curvature, start_curvature
from servobench.design.sampled.taylor_map import TaylorMap, constant, control_points, exponential, products
from servobench.design.sampled.varying_delay import GRIDS, Begin, DelayRange, acts, begins, begun

_WITHIN = 128
"""Instants of a period at which the error is evaluated, some more where commands begin to act."""
_START_PARTS = 64
"""Parts of the period in which the load may come."""
_ALIKE = 1e-6
"""Relative: how well the state at rest has to stay in every step."""
_ORDER = 2
"""Of the polynomials, where the inertia is not one alone."""
_ROOM = 2e-3
"""Share by which norms then fall, for what the polynomials leave out."""
SPEED = 1
"""Place of the speed, or of its error, in the state: the inertia is in its row alone."""


class Shafts(NamedTuple):
    """Inverse inertias from middle - half to middle + half, as multiples of the model's."""

    middle: float = 1.0
    half: float = 0.0

    def halves(self, narrowest: float) -> "list[Shafts]":
        """Return the range in two, unless its ends have no more than the ratio ``narrowest``: then none."""
        low, high = self.middle - self.half, self.middle + self.half
        if high / low < narrowest:
            return []
        between = math.sqrt(low * high)
        return [Shafts(0.5 * (a + b), 0.5 * (b - a)) for a, b in ((low, between), (between, high))]


AS_DESIGNED = Shafts()


class LoadedPeriod(NamedTuple):
    """A period, on d after its first jump."""

    first: Array
    """(k, k): that jump."""
    M: TaylorMap
    """(k, k)."""
    looks: TaylorMap
    """(W, k): errors within it."""
    inputs: Array
    """(2, k): what acts on the plant at its begin and at its end."""
    chain: Sequence[Operation]
    elsewhere: Elsewhere | None = None
    """None: its command acts at no other instants."""


class SteppedLoad:
    """The step on ``loop``, whose period without losses is ``usual``."""

    def __init__(
        self,
        loop: HeldInput,
        period_s: float,
        usual: Sequence[Operation],
        shafts: Shafts = AS_DESIGNED,
        close: float = GRIDS[0],
        parts: int = _START_PARTS,
    ) -> None:
        """``close``: that of the grid of delays, and the share by which norms then fall for what lies
        between; ``parts``: of the period in which the load may come."""
        self._loop, self._period_s, self.order = copy.copy(loop), period_s, _ORDER if shafts.half else 0
        self._close, self._parts = close, parts
        self._loop.model = lighter(loop.model, shafts.middle)
        loaded = LoadedPeriods(self._loop, period_s, 1)
        whole = loaded.period(usual)[0]
        n, size = len(loop.model.A), len(whole) - 1
        rest = np.linalg.lstsq(np.eye(size) - whole[:-1, :-1], whole[:-1, -1], rcond=None)[0]
        self._rest, self._loaded = np.append(rest, 1.0), loaded
        A, B1, B2 = loop.model.A, loop.model.B1, loop.model.B2
        self._look = math.copysign(1.0, loop.model.C @ B2) * loop.model.C
        self.error_at_rest = float(self._look @ rest[:n])
        self._points = control_points(self.order)
        rates = np.zeros((n + 2, n + 2))  # of [x, u, load]
        rates[:n, :n], rates[:n, n], rates[:n, n + 1] = A, B1, B2
        if (
            np.abs(rates[:n] @ np.append(rest[: n + 1], 1.0)).max()
            > _ALIKE * np.abs(rates[:n]).max() * np.abs(rest).max()
        ):
            raise NoSolution("certificate of the peak", "at rest under the load the shaft does not stay")
        self._slope = np.zeros_like(rates)
        self._slope[SPEED] = shafts.half * rates[SPEED]
        self._rates = rates
        self._rates[SPEED] *= shafts.middle
        self._flows: dict[float, TaylorMap] = {}
        self.light = lightest = lighter(loop.model, shafts.middle + shafts.half)
        self.heavy = lighter(loop.model, shafts.middle - shafts.half)
        # bounds grow with the rates, but for a decay that is slower for the others
        slower = math.exp(-2.0 * shafts.half * loop.model.A[SPEED, SPEED] * period_s)
        self._begin(n, size, slower * start_curvature(lightest, period_s))
        of_state, of_input, _ = error_curvature(lightest, period_s)
        share = slower * (period_s / _WITHIN) ** 2 / 8.0
        self._of_state, self._of_input = share * of_state, share * of_input

    def _begin(self, n: int, size: int, curved: Array) -> None:
        h = self._period_s
        shares = np.arange(self._parts + 1) / self._parts
        begun = exponential(h * self._rates, h * self._slope, shares, self.order)
        self.starts = np.zeros((self._parts + 1, self.order + 1, size))
        """(N, m + 1, k): d at the first sample, the load having come 0 .. 1 periods before."""
        self.starts[:, :, :n] = begun.coefficients[:, :, :n, n + 1].transpose(1, 0, 2)
        errors, left = self.starts[:, :, :n] @ self._look, begun.rest[:, :n, n + 1] @ np.abs(self._look)
        self.starts[:, 0] -= self._rest[:-1]
        self._bend = np.zeros((self._parts + 1, size))
        self._bend[:, :n] = (h / self._parts) ** 2 / 8.0 * curved
        between = float(np.abs(self._look) @ self._bend[0, :n])
        self._bend[:, :n] += self._weighed(begun.rest[:, :n, n + 1])
        at_rest = abs(self.error_at_rest)
        ends = np.vander([-1.0, 0.0, 1.0], self.order + 1, increasing=True)
        reached = (np.abs(errors @ ends.T).max(axis=1) - self._weighed(left)).max()
        passed = (np.abs(errors @ self._points.T).max(axis=1) + self._weighed(left)).max()
        self.known = max(float(reached), at_rest), max(float(passed) + between, at_rest)
        """An error that is reached before the first sample or in the end, and a bound of these."""

    def _weighed(self, rest: Array) -> Array:
        """Return what is left out: nothing where the inertia is one alone."""
        return rest if self.order else np.zeros_like(rest)

    def periods(
        self, chain: Sequence[Operation], newest: int, delays: DelayRange | None
    ) -> list[LoadedPeriod]:
        """Return the maps of a period, one for each begin of a grid where its command may act at any of them.

        ``newest``: place of the newest command in xi; ``delays``: None: those of ``chain``.
        """
        if delays is None or not acts(chain):
            return [self.maps(chain)]
        n, grid = len(self._loop.model.A), begins(delays, self._period_s, self.light, self.heavy, self._close)
        return [self.maps(begun(chain, newest, n, each, self._period_s), each) for each in grid]

    def maps(self, chain: Sequence[Operation], begin: Begin | None = None) -> LoadedPeriod:
        """Return those of a period that begins with a jump.

        ``begin``: that of its command, if it may also act at other instants. Raises NoSolution where the
        period moves the state at rest.
        """
        moved = self._loaded.period(chain)[0][:-1] @ self._rest - self._rest[:-1]
        if np.abs(moved).max() > _ALIKE * np.abs(self._rest).max():
            raise NoSolution("certificate of the peak", "what is lost moves the state at rest")
        jump, *later = chain
        assert isinstance(jump, Jump)
        q = len(self._loop.model.A) + 1
        total, looks = constant(np.eye(self._loop.size), self.order), []
        for operation in later:
            if isinstance(operation, Jump):
                total = total.under(operation.J)
            elif operation.length_s > 0.0:
                flows, acted = self._flow(operation.length_s), total.of(slice(q))
                rows = TaylorMap(flows.coefficients[..., : q - 1, :], flows.rest[..., : q - 1, :])
                seen = rows.under(self._look[None]).after(acted)
                looks.append(TaylorMap(seen.coefficients[..., 0, :], seen.rest[..., 0, :]))
                coefficients, rest = total.coefficients.copy(), total.rest.copy()
                coefficients[:, :q], rest[:q] = flows.of(-1).after(acted)
                total = TaylorMap(coefficients, rest)
        every = TaylorMap(
            np.concatenate([each.coefficients for each in looks], axis=1),
            self._weighed(np.concatenate([each.rest for each in looks])),
        )
        whole = TaylorMap(total.coefficients, self._weighed(total.rest))
        held = np.array([np.eye(self._loop.size)[q - 1], self._loop.transition(later)[q - 1]])
        return LoadedPeriod(jump.J, whole, every, held, chain, self._elsewhere(later, begin))

    def _elsewhere(self, later: Sequence[Operation], begin: Begin | None) -> Elsewhere | None:
        if begin is None or not begin.error:
            return None
        n, (_, acting, *rest) = len(self._loop.model.A), later
        assert isinstance(acting, Jump)
        state = np.zeros(self._loop.size)
        state[:n] = begin.state
        for operation in rest:
            if isinstance(operation, Jump):
                state = np.abs(operation.J) @ state
        row = acting.J[n] - np.eye(self._loop.size)[n]
        return Elsewhere(row, state, begin.error, begin.at_end)

    def _flow(self, length_s: float) -> TaylorMap:
        """Return what passes of [x, u] until each instant of ``length_s``, and until its end."""
        if length_s not in self._flows:
            q = len(self._rates) - 1
            parts = max(1, math.ceil(_WITHIN * length_s / self._period_s * (1.0 - 1e-9)))
            shares = length_s * np.arange(1, parts + 1) / parts
            self._flows[length_s] = exponential(self._rates[:q, :q], self._slope[:q, :q], shares, self.order)
        return self._flows[length_s]

    def edge(self, source: int, target: int, period: LoadedPeriod, firsts: Array) -> NormedEdge:
        """Return what the norms have to bear of a period, whose first jump is one of the hull of ``firsts``
        (N, k, k)."""
        hull = np.tensordot(self._points, period.M.coefficients, axes=1)
        rows = np.tensordot(self._points, period.looks.coefficients, axes=1).transpose(1, 0, 2)
        n, k = len(self._of_state), self._loop.size
        between = np.zeros((len(firsts), n + 2, k))
        between[:, :n, :n] = np.diag(self._of_state)
        between[:, n:] = self._of_input * period.inputs @ firsts
        return NormedEdge(
            source,
            target,
            (hull @ firsts[:, None]).reshape(-1, k, k),
            (rows.reshape(-1, k) @ firsts).reshape(-1, k),
            firsts,
            between,
            period.M.rest,
            period.looks.rest,
            max(self._close, _ROOM) if period.elsewhere else _ROOM if self.order else 0.0,
            period.elsewhere,
            period.elsewhere is None or period.elsewhere.at_end,
        )

    def begun(self, node: int, norms: FallingNorms, memory: Array) -> Leaves:
        """Return the leaves at ``node``, one for each begin of the load and row of ``memory`` (N, m)."""
        count, parts = len(memory), len(self.starts)
        bend = np.linalg.norm(self._bend @ np.abs(norms.T[node]).T, axis=1)
        return Leaves(
            np.full(count * parts, node),
            np.tile(self.starts.reshape(parts, -1), (count, 1)),
            np.tile(bend, count),
            np.repeat(memory, parts, axis=0),
            np.zeros(count * parts),
        )

    def apart(self, d: Array) -> Array:
        """Return the coefficients (N, m + 1, k) of leaves' d."""
        return d.reshape(len(d), self.order + 1, -1)

    def control(self, values: Array) -> Array:
        """Return the values (N, m + 1, ..) in whose hull those of every u lie; ``values``: coefficients."""
        return np.asarray(np.einsum("ij,nj...->ni...", self._points, values))

    def errors(self, z: Array, d: Array, period: LoadedPeriod, opened: Array) -> tuple[Array, Array, Array]:
        """Return (N,) largest errors: reached at some inertia, a bound at the instants, and how far it may be
        exceeded between these.

        ``z``, ``d`` (N, m + 1, k): after the first jump and before it; ``opened`` (N, k): how far each entry
        of z may differ.
        """
        order, n = self.order, len(self._of_state)
        used = np.flatnonzero(np.abs(period.looks.coefficients).max(axis=(0, 1)))
        looks = period.looks.coefficients[:, :, used].transpose(0, 2, 1)
        seen = products(z[:, :, used].transpose(1, 0, 2), looks)
        seen[0] = seen[0] + self.error_at_rest
        left = np.abs(z).sum(axis=1) @ period.looks.rest.T
        left += opened @ (np.abs(period.looks.coefficients).sum(axis=0) + period.looks.rest).T
        powers = np.vander([-1.0, -0.5, 0.0, 0.5, 1.0] if order else [0.0], len(seen), increasing=True)
        reached = (np.abs(np.tensordot(powers, np.array(seen), axes=1)).max(axis=0) - left).max(axis=1)
        hull = np.tensordot(self._points, np.array(seen[: order + 1]), axes=1)
        over = sum((np.abs(each) for each in seen[order + 1 :]), left)
        bound = (np.abs(hull).max(axis=0) + over).max(axis=1)
        if period.elsewhere is not None:
            bound += period.elsewhere.error * self._changed(z, period.elsewhere, opened)
        held = np.abs(self.control(z @ period.inputs.T)).max(axis=(1, 2))
        held += (opened @ np.abs(period.inputs).T).max(axis=1)
        state = np.abs(self.control(d[:, :, :n])).max(axis=1)
        return reached, bound, state @ self._of_state + self._of_input * held

    def _changed(self, z: Array, elsewhere: Elsewhere, opened: Array) -> Array:
        """Return (N,): by how much at most a command changes the input."""
        known = np.abs(self.control(z @ elsewhere.row)).max(axis=1)
        return np.asarray(known + opened @ np.abs(elsewhere.row))

    def apart_by(self, z: Array, period: LoadedPeriod, opened: Array, T: Array) -> Array:
        """Return (N,): how far at most a command that acts at another instant leads from d, in the norm of
        ``T``."""
        if period.elsewhere is None:
            return np.zeros(len(z))
        size = float(np.linalg.norm(np.abs(T) @ period.elsewhere.state))
        return size * self._changed(z, period.elsewhere, opened)


class NormedWalks:
    """Walks of the departure ``d`` from rest, in ``norms`` that no period enlarges."""

    def __init__(self, norms: Norms, step: SteppedLoad) -> None:
        self._norms, self._step, self.left = norms, step, norms.first.left

    def bounds(self, leaves: Leaves) -> Array:
        """Return (N,): what no error behind each leaf exceeds."""
        hull = self._step.control(self._step.apart(leaves.d))
        many = hull.shape[1]
        sizes = self._norms.sizes(np.repeat(leaves.node, many), hull.reshape(len(leaves.d) * many, -1))
        return np.asarray(abs(self._step.error_at_rest) + sizes.reshape(-1, many).max(axis=1) + leaves.radius)

    def refine(self, leaves: Leaves) -> None:
        """Sharpen the bounds for some leaves."""
        self._norms.refine(leaves.node, self._step.apart(leaves.d)[:, 0])

    def merged(self, leaves: Leaves, radius: float) -> Leaves:
        """Return fewer leaves that stand for all: one takes in those around it, until it has this radius."""
        keys = np.column_stack([leaves.node, leaves.memory])
        _, group = np.unique(keys, axis=0, return_inverse=True)
        hull = self._step.control(self._step.apart(leaves.d))
        turned = np.einsum("nij,nmj->nmi", self._norms.first.T[leaves.node], hull)
        kept, wider = np.zeros(len(leaves.d), dtype=bool), leaves.radius.copy()
        for number in range(int(group.max()) + 1):
            own = np.flatnonzero(group.ravel() == number)
            covers, radii = covered(turned[own], leaves.radius[own], radius)
            kept[own[covers]] = True
            wider[own[covers]] = radii
        return leaves._replace(radius=wider).part(np.flatnonzero(kept))

    def moved(self, z: Array, opened: Array, period: LoadedPeriod, target: int) -> tuple[Array, Array, Array]:
        """Return the coefficients of d a period later, flat, and in the first norm (N,) what these leave out,
        and how far other begins of the command lead from them.

        ``z``, ``opened``: as for :meth:`SteppedLoad.errors`.
        """
        T, order = self._norms.first.T[target], self._step.order
        later = products(z.transpose(1, 0, 2), period.M.coefficients.transpose(0, 2, 1))
        wider = np.linalg.norm(np.abs(z).sum(axis=1) @ (np.abs(T) @ period.M.rest).T, axis=1)
        for beyond in later[order + 1 :]:
            wider = wider + np.linalg.norm(beyond @ T.T, axis=1)
        flat = np.stack(later[: order + 1], axis=1).reshape(len(z), -1)
        return flat, wider, self._step.apart_by(z, period, opened, T)


def lighter(model: SpeedModel, factor: float) -> SpeedModel:
    """Return ``model`` with so many times the inverse of its inertia."""
    A, B1, B2 = (each.copy() for each in (model.A, model.B1, model.B2))
    for each in (A, B1, B2):
        each[SPEED] *= factor
    return replace(model, A=A, B1=B1, B2=B2)
