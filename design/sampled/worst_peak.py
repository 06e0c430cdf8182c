"""Searches over sequences for the largest speed error after a load step in a sampled loop.

The load steps by 1 N m at rest, somewhere in a period; from then on the network does its worst. A beam keeps,
period by period, the sequences whose error is largest now, and those in which it grows fastest. The error
found is reached: no bound for every sequence can be lower. It proves no upper bound.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.admissible_steps import families
from servobench.design.sampled.held_loop import HeldLoop, PeriodStep

_BEAM = 150
"""Sequences kept for each node and each of the two orders."""
_PHASES = (0.0, 0.25, 0.5, 0.75)
"""Parts of a period after a sample at which the load steps."""
_ENDS = (0.0, 1.0)
"""Parts of its window at which a switching is tried."""
_INSTANTS = 8
"""Instants between two switchings at which the error is evaluated."""
_PERIODS_MIN = 40
"""For ages below five periods; six loops reach their peak within 10."""
_AGES = 8
"""The search lasts this many of the largest ages, and a few periods at least."""


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """A period under load: map of [xi, 1] (kept + 1, kept + 1), and rows of the error within it."""

    source: int
    target: int
    M: Array
    errors: Array


def worst_peak(loop: HeldLoop) -> float:
    """Return the largest error found, rad/s per N m."""
    steps = [_under_load(loop, step) for family in families(loop.network) for step in family.over(_ENDS)]
    h, k = loop.network.period_s, loop.kept
    periods = max(_PERIODS_MIN, int(_AGES * loop.network.age_max_s / h))
    model = loop.model
    rest = np.linalg.solve(model.A + np.outer(model.B1, loop.K), -model.B2)
    best = abs(float(model.C @ rest))
    for phase in _PHASES:
        rest_s = (1.0 - phase) * h
        start = np.append(np.zeros(k), 1.0)
        start[: len(loop.model.A)] = (_loaded(loop, rest_s) @ np.append(np.zeros(loop.size), 1.0))[
            : len(loop.model.A)
        ]
        beams = {node: start[None, :] for node in {step.source for step in steps}}
        for _ in range(periods):
            reached: dict[int, list[Array]] = {}
            for step in steps:
                if step.source not in beams:
                    continue
                states = beams[step.source]
                best = max(best, float(np.max(np.abs(states @ step.errors.T))))
                reached.setdefault(step.target, []).append(states @ step.M.T)
            beams = {node: _kept(loop, np.vstack(states)) for node, states in reached.items()}
    return best


def _kept(loop: HeldLoop, states: Array) -> Array:
    """Return the states of largest error and of its largest slope, either sign."""
    n = len(loop.model.A)
    error = states[:, :n] @ loop.model.C
    slope = states[:, :n] @ (loop.model.C @ loop.model.A)
    chosen: set[int] = set()
    for order in (
        np.argsort(-np.abs(error), kind="stable"),
        np.argsort(-slope * np.sign(error), kind="stable"),
    ):
        chosen |= set(order[:_BEAM].tolist())
    return np.asarray(states[sorted(chosen)])


def _loaded(loop: HeldLoop, length_s: float) -> Array:
    """Return the flow of [xi, 1] under a load of 1 N m."""
    size = loop.size
    F = np.zeros((size + 1, size + 1))
    F[:size, :size] = loop.generator
    F[: len(loop.model.A), size] = loop.model.B2
    return np.asarray(expm(F * length_s))


def _under_load(loop: HeldLoop, step: PeriodStep) -> _Step:
    size, k = loop.size, loop.kept
    total = np.zeros((size + 1, k + 1))
    total[:k, :k], total[size, k] = np.eye(k), 1.0
    jumps = [loop.sampling, *(loop.applying(switch.back) for switch in step.switches)]
    instants = [0.0, *(switch.at_s for switch in step.switches), loop.network.period_s]
    C = np.append(loop.model.C, np.zeros(size + 1 - len(loop.model.C)))
    errors = []
    for J, (begin_s, end_s) in zip(jumps, itertools.pairwise(instants), strict=True):
        total[:size] = J @ total[:size]
        flow = _loaded(loop, max(0.0, end_s - begin_s) / _INSTANTS)
        for _ in range(_INSTANTS):
            total = flow @ total
            errors.append(C @ total)
    M = np.zeros((k + 1, k + 1))
    M[:k], M[k] = total[:k], total[size]
    return _Step(step.source, step.target, M, np.array(errors))
