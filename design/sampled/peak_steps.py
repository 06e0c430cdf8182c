"""The steps of a sampled loop under a load of 1 N m: from sample to sample, and the error in between.

A state is xi of :mod:`servobench.design.sampled.held_loop`, its step xi+ = M xi + m, and the error at an
instant t of the period c xi + e. With the moments of switching between those of the corners
(:mod:`servobench.design.sampled.step_maps`) both lie in the hull of the corners' results, except for

    |R_s| |Delta_s xi|   of each state,   Z_s |Delta_s xi|   of the error at any instant

and between two instants the error departs from its chord by at most width^2/8 times its largest z''.

The largest error after a load step over every walk of a graph: best first, to any closeness.

A leaf is a state that some walk has reached, its node, and a radius: how far, in a norm that no step
enlarges (:mod:`servobench.design.sampled.falling_norms`), a loop that this leaf stands for may lie from it.
No error behind a leaf exceeds |rest| + V(d) + radius. The leaf of the largest bound is stepped through every
edge, again and again; a leaf whose bound is not above the goal is done. At any moment the largest bound of
the leaves left, and the largest error passed, is certified.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial import cKDTree

from servobench.design.delay.delay_loop import Array, SpeedModel
from servobench.design.errors import NoSolution
from servobench.design.sampled.admissible_steps import Family
from servobench.design.sampled.held_loop import HeldLoop
from servobench.design.sampled.step_maps import Corners

_GROWTH_PARTS = 64
_INSTANTS_MIN, _INSTANTS_MAX = 8, 400


@dataclass(frozen=True, slots=True)
class PeakBound:
    """The bound, and the largest error reached on the way, rad/s per N m."""

    certified: float
    reached: float


@dataclass(frozen=True, slots=True, eq=False)
class LoadedSteps:
    """All steps of an edge."""

    source: int
    target: int
    M: Array
    """(N, kept, kept) of each corner."""
    m: Array
    """(N, kept)."""
    rows: Array
    """(R, kept): c of each corner and instant."""
    errors: Array
    """(R,): e."""
    differences: Array
    """(windows, kept): Delta_s."""
    bends: Array
    """(windows, n): R_s, the largest of all cells."""
    output_bends: Array
    """(windows,): Z_s."""
    inputs: Array
    """(I, kept): the inputs that may act within the period."""


def rest_under_load(loop: HeldLoop) -> Array:
    """Return xi at rest under the load, (kept,)."""
    model = loop.model
    x = np.linalg.solve(model.A + np.outer(model.B1, loop.K), -model.B2)
    return np.concatenate([x, np.full(loop.kept - len(x), float(loop.K @ x))])


def first_states(loop: HeldLoop, parts: int) -> Array:
    """Return (parts + 1, kept): states at the first sample, the load having begun up to a period before."""
    times = np.linspace(0.0, loop.network.period_s, parts + 1)
    states = np.zeros((parts + 1, loop.kept))
    states[:, : len(loop.model.A)] = responses(loop, times)[2]
    return states


def responses(loop: HeldLoop, times_s: Array) -> tuple[Array, Array, Array]:
    """Return e^{At}, and the state's response to the input and to the load of 1 in t: (N, n, n), (N, n), (N,
    n)."""
    A, n = loop.model.A, len(loop.model.A)
    F = np.zeros((n + 2, n + 2))
    F[:n, :n], F[:n, n], F[:n, n + 1] = A, loop.model.B1, loop.model.B2
    whole = expm(F * np.asarray(times_s, dtype=float)[:, None, None])
    return whole[:, :n, :n], whole[:, :n, n], whole[:, :n, n + 1]


def loaded_steps(loop: HeldLoop, source: int, target: int, corners: Corners, instants: int) -> LoadedSteps:
    """Return the steps of one edge; the error at ``instants`` times in a period."""
    model, h = loop.model, loop.network.period_s
    n, k, C = len(model.A), loop.kept, loop.model.C
    family = corners.family
    chains = [loop.chain(family.at(times)) for times in corners.times_s.tolist()]
    M = np.array([loop.kept_transition(chain) for chain in chains])
    m = np.zeros((len(M), k))
    m[:, :n] = responses(loop, np.array([h]))[2][0]
    times = np.linspace(0.0, h, instants + 1)
    Phi, Gamma, Psi = responses(loop, times)
    plain = np.zeros((len(times), k))
    plain[:, :n], plain[:, n] = Phi.transpose(0, 2, 1) @ C, Gamma @ C
    rows = np.broadcast_to(plain, (len(M), *plain.shape)).copy()
    for s in range(len(family.windows)):
        after = np.maximum(times[None, :] - corners.times_s[:, s, None], 0.0)
        unique, place = np.unique(after.ravel(), return_inverse=True)
        gain = (responses(loop, unique)[1] @ C)[place].reshape(after.shape)
        rows += gain[:, :, None] * corners.differences[s]
    windows = len(family.windows)
    bends = corners.bends.max(axis=0) if windows else np.zeros((0, n))
    outputs = np.array([_output_bend(loop, corners.times_s[:, s]) for s in range(windows)])
    errors = np.tile(Psi @ C, len(M))
    inputs = inputs_of(loop, family)
    rows, differences = rows.reshape(-1, k), corners.differences
    return LoadedSteps(source, target, M, m, rows, errors, differences, bends, outputs, inputs)


def inputs_of(loop: HeldLoop, family: Family) -> Array:
    """Return the inputs that may act within a period; the one held before it, unless replaced at once."""
    replaced = bool(family.windows) and family.windows[0].last_s == 0.0
    held = np.eye(loop.kept)[len(loop.model.A)]
    after = loop.differences([window.back for window in family.windows]).cumsum(axis=0) + held
    return after if replaced else np.vstack([held, after])


def _output_bend(loop: HeldLoop, times_s: Array) -> float:
    """Return Z_s: the error's response to a step of the input starts without slope, with this curvature."""
    grid = np.unique(times_s)
    width = float(np.max(np.diff(grid), initial=0.0))
    return width**2 / 8.0 * _slope_max(loop) if width else 0.0


def _slope_max(loop: HeldLoop) -> float:
    """Bound |C A e^{At} B1| within a period."""
    model = loop.model
    return float(np.abs(model.C @ model.A) @ _growth(model, loop.network.period_s) @ np.abs(model.B1))


def _growth(model: SpeedModel, period_s: float) -> Array:
    """Bound |e^{At}| within a period, entry by entry: at some instants, and between these without decay."""
    bound = np.abs(model.A)
    np.fill_diagonal(bound, np.diag(model.A))
    growing = np.maximum(bound, 0.0)
    at_s = period_s * np.arange(_GROWTH_PARTS) / _GROWTH_PARTS
    at_instants = expm(bound * at_s[:, None, None])
    return np.asarray(expm(growing * (period_s / _GROWTH_PARTS)) @ at_instants.max(axis=0))


def instants_for(bend: float, allowed: float) -> int:
    """Return the number of instants at which an error that ``bend`` from its chord over a whole period
    departs from its chords by at most ``allowed``."""
    instants = math.ceil(math.sqrt(bend / allowed))
    return min(max(instants, _INSTANTS_MIN), _INSTANTS_MAX)


def error_curvature(model: SpeedModel, period_s: float) -> tuple[Array, float, float]:
    """Bound the error's second derivative within a period, linear in bounds of three things.

    Of the state at the period's begin (n,), of all inputs within it, and of the load. Raises NoSolution.
    """
    A, C = model.A, model.C
    if abs(C @ model.B1) > 0.0:
        raise NoSolution("certificate of the peak", "the input acts on the error at once")
    # with e = C x the second derivative jumps with the input, the first does not
    row = np.abs(C @ A @ A)
    of_input, of_load = (
        float(row @ _filled(A, np.abs(B), period_s)) + abs(float(C @ A @ B)) for B in (model.B1, model.B2)
    )
    return row @ _growth(model, period_s), of_input, of_load


def _filled(A: Array, B: Array, period_s: float) -> Array:
    """Bound what an input of at most 1 makes of the state within a period, entry by entry."""
    n = len(A)
    bound = np.zeros((n + 1, n + 1))
    bound[:n, :n], bound[:n, n] = np.abs(A), B
    np.fill_diagonal(bound[:n, :n], np.diag(A))
    return np.asarray(expm(bound * period_s)[:n, n])


def between_instants(loop: HeldLoop, x: Array, held: float, instants: int, load: float = 1.0) -> float:
    """Return how far the error may depart from its chords between the instants of a period.

    ``x`` (n,), ``held``: bounds of the state at the period's begin, and of all inputs within it; ``load``: N
    m.
    """
    h = loop.network.period_s
    of_state, of_input, of_load = error_curvature(loop.model, h)
    return float((h / instants) ** 2 / 8.0 * (of_state @ x + of_input * held + of_load * load))


def start_curvature(model: SpeedModel, period_s: float) -> Array:
    """Bound the second derivative of the state in the first period under load, (n,)."""
    return np.asarray(np.abs(model.A) @ _growth(model, period_s) @ np.abs(model.B2))


_AT_ONCE = 4000
"""Leaves stepped at once."""
_REFINED_AFTER = 60_000
"""Leaves stepped until bounds are sharpened, again and again."""
_REFINED_AT, _REFINED_FROM = 40, 50
"""Leaves for which that is done, each so many of the largest bounds."""

_CROWDED = 2000
"""Leaves from which those near each other are merged."""
_MERGED = 0.4
"""Share of the closeness asked to which that may widen them."""


class Leaves(NamedTuple):
    """States reached, (N, ..) each."""

    node: NDArray[np.intp]
    d: Array
    """(N, k): departure from rest."""
    radius: Array
    memory: Array
    """(N, m): what the controller knows of the past, if its node does not tell."""
    doubt: Array
    """The part of the radius within which what is really reached lies."""

    def part(self, which: NDArray[np.intp]) -> "Leaves":
        """Return some of them."""
        node, *others = self
        return Leaves(node[which], *(own[which] for own in others))


class Steps(Protocol):
    """The graph."""

    def bounds(self, leaves: Leaves) -> Array:
        """Return (N,): what no error behind each leaf exceeds."""

    def refine(self, leaves: Leaves) -> None:
        """Sharpen the bounds for some leaves."""

    def merged(self, leaves: Leaves, radius: float) -> Leaves:
        """Return fewer leaves that stand for all, none widened beyond ``radius``."""

    def stepped(self, leaves: Leaves) -> tuple[Leaves, float, float]:
        """Return the leaves a period later, the largest error passed, and what none exceeded."""


def covered(points: Array, radii: Array, radius: float) -> tuple[NDArray[np.intp], Array]:
    """Return which balls cover all of them when widened to at most ``radius``, and their radii.

    ``points`` (N, m, k): the distance of two is the largest of m Euclidean ones.
    """
    flat, free = points.reshape(len(points), -1), np.ones(len(points), dtype=bool)
    tree, reach = cKDTree(flat), max(radius - float(radii.min()), 0.0)
    chosen, widened = [], []
    for place in np.argsort(radii, kind="stable")[::-1]:
        if not free[place]:
            continue
        others = np.array(tree.query_ball_point(flat[place], reach))
        others = others[free[others]]
        apart = np.linalg.norm(points[others] - points[place], axis=2).max(axis=1) + radii[others]
        apart[others == place] = radii[place]
        inside = apart <= max(radius, radii[place])
        free[others[inside]] = False
        chosen.append(place)
        widened.append(float(apart[inside].max()))
    return np.array(chosen), np.array(widened)


def joined(parts: list[Leaves]) -> Leaves:
    """Return all of them as one."""
    node, *others = (np.concatenate(own) for own in zip(*parts, strict=True))
    return Leaves(node, *others)


def bounded_peak(
    steps: Steps, first: Leaves, known: tuple[float, float], closeness: float, leaves_max: int
) -> PeakBound:
    """Return the bound of every walk from ``first``, and the largest error reached.

    ``known``: an error that is reached, and a bound of those before ``first``; ``closeness``: relative, at
    which the search ends; ``leaves_max``: leaves stepped until it ends anyway.
    """
    left, done, count, refined, crowded = first, 0.0, 0, _REFINED_AFTER, _CROWDED
    reached, passed = known
    bounds = steps.bounds(left)
    while len(bounds):
        goal = max((1.0 + closeness) * reached, passed)
        over = bounds > goal
        if not over.all():
            done = max(done, float(bounds[~over].max()))
            left, bounds = left.part(np.flatnonzero(over)), bounds[over]
        if count > leaves_max or not len(bounds):
            break
        places = np.arange(len(bounds))
        if len(bounds) > _AT_ONCE:
            places = np.argpartition(-bounds, _AT_ONCE)
        taken, kept = places[:_AT_ONCE], places[_AT_ONCE:]
        if count >= refined:
            largest = np.argsort(-bounds)[: _REFINED_FROM * _REFINED_AT : _REFINED_FROM]
            steps.refine(left.part(largest))
            bounds, refined = steps.bounds(left), refined + _REFINED_AFTER
            continue
        came, error, bound = steps.stepped(left.part(taken))
        count += len(taken)
        reached, passed = max(reached, error), max(passed, bound)
        came_bounds = steps.bounds(came)
        open_ = np.flatnonzero(came_bounds > max((1.0 + closeness) * reached, passed))
        done = max(done, float(np.delete(came_bounds, open_).max(initial=0.0)))
        left = joined([left.part(kept), came.part(open_)])
        bounds = np.concatenate([bounds[kept], came_bounds[open_]])
        if len(left.d) > crowded:
            left = steps.merged(left, _MERGED * closeness * reached)
            bounds, crowded = steps.bounds(left), max(_CROWDED, 2 * len(left.d))
    return PeakBound(max(passed, done, float(bounds.max(initial=0.0))), reached)
