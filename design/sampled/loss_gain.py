"""The gain from load torque to speed error over every sequence of lost readings and commands, and every
inertia of a range.

The graph is that of :mod:`servobench.design.sampled.loss_peak`; its nodes remember the last periods as far as
that proves more (:mod:`servobench.design.sampled.sequence_certificate`). With theta the inverse inertia the
current does not depend on it, and the speed, an integral of theta times current and load, nearly by a line:
for a period, in units of theta = 1,

    omega' = theta (kappa i - beta omega - b d)     |d^2 omega/d theta^2| <= 2 beta h sup |d omega/d theta|

So state and error depart from the chord of theta's two ends by at most width^2/8 of that, and for any epsilon

    value(theta) <= (1 + epsilon) max over the ends of value at a smaller gain + (1 + 1/epsilon) departures^2

which is what lies between two corners in :mod:`servobench.design.sampled.step_maps`. The part of the
disturbance is a share of the gain. The inertia is constant, so each part of the range has its own functions.
"""

import copy
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from servobench.design.delay.delay_loop import Array, SpeedModel
from servobench.design.errors import NoSolution
from servobench.design.sampled.admissible_steps import Family, Window
from servobench.design.sampled.held_loop import (
    Jump,
    Operation,
    PeriodStep,
    SampledNetwork,
    Strategy,
    Switch,
    SwitchedLoop,
)
from servobench.design.sampled.jump_loop import Remembering
from servobench.design.sampled.loss_patterns import (
    SCORING,
    Pattern,
    letter_maps,
    often,
    pattern_gains,
    pattern_of,
)
from servobench.design.sampled.loss_peak import Move, parts_of, walked
from servobench.design.sampled.pattern_chains import Letter, product_of, root_of
from servobench.design.sampled.sequence_certificate import least_gain, near_enough
from servobench.design.sampled.sequence_graph import Edge
from servobench.design.sampled.sequence_inequalities import coordinates_of
from servobench.design.sampled.step_maps import Corners
from servobench.design.sampled.stepped_load import SPEED, Shafts, lighter

_EPSILON, _OF_LOAD = 1e-4, 1e-3
"""epsilon above, and the share of the gain's square for the disturbance's part: they cost half as much."""
_MEMORY_MAX, _UNKNOWNS_MAX, _EDGES_MAX = 6, 1500, 130
"""Periods that nodes remember, and the largest problem: it takes some ten seconds."""
_UNITS_AT = (1.2, 2.0, 5.0)
"""Multiples of the largest gain at which the value functions give the units."""
_WORDS_MAX = 200
"""Closed walks tried before the worst is changed."""
_INSERTED, _LENGTH_MAX, _ROUNDS = 3, 24, 12
"""Periods of a closed walk put into the worst, periods of the longest result, and rounds of that."""
_TOLERANCE = 1e-4
_WORTHWHILE, _ROUNDING = 1.0005, 1e-9
_ENOUGH, _NARROWEST = 1.05, 1.05
"""Ratio of certified to found from which a part of the range is halved, and of the ends of one that is
not."""

Word = tuple[int, ...]
"""Periods, by number."""


class GainBound(NamedTuple):
    """Gains, rad/s per N m, of every sequence and of the worst found."""

    certified: float
    found: float


class _Moved(SwitchedLoop):
    """A controller's loop; a step is one of ``moves``, by its number as the source."""

    def __init__(self, controller: Remembering, moves: Sequence[Move], model: SpeedModel) -> None:
        self._chains = [list(controller.chain(move.memory, move.outcome)) for move in moves]
        size = controller.loop.size
        first = [chain[0] for chain in self._chains]
        # an entry that no period begins with counts within periods alone
        forgotten = all(isinstance(each, Jump) and not each.J[:, -1].any() for each in first)
        network = SampledNetwork(Strategy.STAMP, controller.period_s, 0, 0.0)
        super().__init__(model, network, size, size - 1 if forgotten else size)

    def chain(self, step: PeriodStep) -> list[Operation]:
        return self._chains[step.source]

    def with_inertia(self, inverse: float) -> "_Moved":
        """Return the same with so many times the inverse of its inertia."""
        other = copy.copy(self)
        other.model = lighter(self.model, inverse)
        return other


def losses_gain(
    controller: Remembering, readings_max: int, commands_max: int, inertias: tuple[float, float] = (1.0, 1.0)
) -> GainBound:
    """Return the gain with at most so many readings and commands lost in a row.

    ``inertias``: smallest and largest, as multiples of the model's. Raises NoSolution.
    """
    moves = list(walked(controller, readings_max, commands_max))
    loop = _Moved(controller, moves, controller.loop.model)
    _require_plain(loop.model)
    parts, certified, found = parts_of(inertias), 0.0, 0.0
    known: list[Word] = []
    while parts:
        part = parts.pop()
        ends = [loop.with_inertia(each) for each in _ends(part)]
        words, gains = zip(*(_worst(end, moves, known) for end in ends), strict=True)
        known, found = list(words), max(found, *gains)
        if math.isinf(found):
            raise NoSolution("certificate of the gain", "a pattern is known that destabilises the loop")
        gain = _certified(ends, moves, known, max(gains))
        if gain is None or gain > max(certified, _ENOUGH * found):
            # narrower, more may be proved
            halves = part.halves(_NARROWEST)
            if halves:
                parts += halves
                continue
        if gain is None:
            raise NoSolution("certificate of the gain", "no quadratic functions were found")
        certified = max(certified, gain)
    return GainBound(certified, found)


def _ends(part: Shafts) -> list[float]:
    if not part.half:
        return [part.middle]
    return [part.middle - part.half, part.middle + part.half]


def _require_plain(model: SpeedModel) -> None:
    """Raise NoSolution where the bounds of the departures do not hold: for a plant of another form."""
    A, B1, B2, C = model.A, model.B1, model.B2, model.C
    others = [row for row in range(len(A)) if row != SPEED]
    current = np.delete(A[0], 0).any() or not 0.0 <= B1[0] <= -A[0, 0] * (1.0 + _ROUNDING)
    follows = any(np.delete(A[row], [SPEED, row]).any() or A[row, row] > 0.0 for row in others[1:])
    speed = np.delete(A[SPEED], [0, SPEED]).any() or A[SPEED, SPEED] > 0.0
    elsewhere = B1[1:].any() or B2[others].any() or np.delete(C, SPEED).any()
    if current or follows or speed or elsewhere:
        raise NoSolution("certificate of the gain", "the plant is not a rigid shaft behind a current loop")


def _closed(moves: Sequence[Move], start: int, longest: int) -> Iterator[Word]:
    """Yield the closed walks from and to a node."""
    words: list[tuple[Word, int]] = [((), start)]
    for _ in range(longest):
        words = [
            ((*word, letter), move.target)
            for word, node in words
            for letter, move in enumerate(moves)
            if move.source == node
        ]
        yield from (word for word, node in words if node == start)


def _worst(loop: SwitchedLoop, moves: Sequence[Move], known: Sequence[Word]) -> tuple[Word, float]:
    """Return the closed walk of largest gain found, and that gain."""
    nodes = range(1 + max(move.target for move in moves))
    short = {node: list(_closed(moves, node, _INSERTED)) for node in nodes}
    words: dict[Word, None] = dict.fromkeys(known)
    for longest in range(1, _LENGTH_MAX + 1):
        now = {_turned(word) for node in nodes for word in _closed(moves, node, longest)}
        words.update(dict.fromkeys(sorted(now)))
        if len(words) > _WORDS_MAX or len(moves) == 1:
            break
    best = _better(loop, list(words), ((), 0.0))
    for _ in range(_ROUNDS):
        word = best[0]
        longer = {
            _turned((*word[:place], *other, *word[place:]))
            for place, letter in enumerate(word)
            for other in short[moves[letter].source]
            if len(word) + len(other) <= _LENGTH_MAX
        }
        before, best = best, _better(loop, sorted(longer), best)
        if best == before:
            break
    return best


def _better(loop: SwitchedLoop, words: Sequence[Word], best: tuple[Word, float]) -> tuple[Word, float]:
    """Return the word of largest gain of some, if that exceeds the ``best`` so far."""
    left = list(words)
    letters = sorted({letter for word in left for letter in word})
    steps = [Letter((_step(letter),)) for letter in letters]
    while left and not math.isinf(best[1]):
        if best[1]:
            maps = letter_maps(loop, steps, _WORTHWHILE * best[1])
            chains = [tuple(map(letters.index, word)) for word in left]
            exceeding = ~often(product_of(maps, chains), SCORING).bounded
            left = list(itertools.compress(left, exceeding))
        if left:
            gain = float(pattern_gains(loop, [_pattern(loop, left[0])], _TOLERANCE)[0])
            best = max(best, (left.pop(0), gain), key=lambda each: each[1])
    return best


def _step(letter: int) -> PeriodStep:
    return PeriodStep(letter, 0, (Switch(0, 0.0),))


def _pattern(loop: SwitchedLoop, word: Word) -> Pattern:
    return pattern_of(loop, list(map(_step, word)))


def _turned(word: Word) -> Word:
    """Return the first of the words that are the same closed walk, for ever repeated."""
    word = root_of(word)
    return min(word[place:] + word[:place] for place in range(len(word)))


def _certified(
    ends: Sequence[_Moved], moves: Sequence[Move], worst: Sequence[Word], found: float
) -> float | None:
    """Return the least gain certified for every inertia between ``ends``; None if none is."""
    loop, best = ends[0], math.inf
    short = [word for node in {move.source for move in moves} for word in _closed(moves, node, 2)]
    patterns = [_pattern(loop, word) for word in dict.fromkeys([*worst, *short])]
    patterns = [each for each in patterns if each.decay_per_s > 0.0]
    for units_at in _UNITS_AT:
        L = coordinates_of(loop, patterns, units_at * found)
        plain, nodes = _edges(ends, moves), 0
        for remembered in range(_MEMORY_MAX + 1):
            before_nodes, (nodes, edges) = nodes, _remembering(plain, moves, remembered)
            if (
                nodes == before_nodes
                or len(edges) > _EDGES_MAX
                or nodes * loop.kept * (loop.kept + 1) // 2 > _UNKNOWNS_MAX
            ):
                break
            proof = least_gain(loop, nodes, edges, L, found)
            before = best / found - 1.0
            if proof is not None and _load_is_covered(ends, proof.P, proof.figure):
                best = min(best, proof.figure)
            if math.isfinite(best) and near_enough(before, best / found - 1.0):
                break
        if math.isfinite(best):
            return best
    return None


def _remembering(edges: Sequence[Edge], moves: Sequence[Move], remembered: int) -> tuple[int, list[Edge]]:
    """Return the graph whose nodes know the last periods: their number, and the edges."""
    numbers: dict[tuple[int, Word], int] = {}
    past = [(move.target, (letter,)[:remembered]) for letter, move in enumerate(moves)]
    for _ in range(remembered - 1):
        past = [
            (move.target, (*word, letter)[-remembered:])
            for node, word in past
            for letter, move in enumerate(moves)
            if move.source == node
        ]
    for each in past:
        numbers.setdefault(each, len(numbers))
    grown = []
    for node, word in list(numbers):
        for edge in edges:
            letter = edge.corners.family.source
            if edge.source != node:
                continue
            later = edge.target, (*word, letter)[-remembered:] if remembered else ()
            grown.append(replace(edge, source=numbers[node, word], target=numbers[later]))
    return len(numbers), grown


def _edges(ends: Sequence[_Moved], moves: Sequence[Move]) -> list[Edge]:
    """Return each move with each end of the range, and what lies between the ends."""
    edges, single = [], len(ends) == 1
    for letter, move in enumerate(moves):
        rows, bend, error = _departures(ends, letter)
        r, n = len(rows), len(bend)
        none = np.zeros((1, r))
        bends, errors = np.broadcast_to(bend, (1, r, n)).copy(), none + error
        # the disturbance's departure is one more term
        more = math.sqrt((r + 1.0) / r)
        corners = Corners(
            Family(letter, 0, (Window(0, 0.0, 0.0),)),
            np.zeros((1, 1)),
            0.0 * bends if single else more * bends,
            none if single else more * errors,
            rows,
            none,
            np.zeros(1),
        )
        epsilon, of_load = (0.0, 0.0) if single else (_EPSILON, _OF_LOAD)
        edges += [
            Edge(move.source, move.target, replace(corners), end, epsilon, ends_epsilon=of_load)
            for end in ends
        ]
    return edges


def _departures(ends: Sequence[_Moved], letter: int) -> tuple[Array, Array, float]:
    """Return what the inertia acts by in a period, (r, kept) rows of xi at its begin, and by how much a 1 of
    each makes the state at its end, (n,), and the error within it, depart from the chord."""
    loop = ends[0]
    n, k = len(loop.model.A), loop.kept
    first, *later = loop.chain(_step(letter))
    assert isinstance(first, Jump)
    total = first.J
    rows = [total[0], total[SPEED], total[n]]
    for operation in later:
        if isinstance(operation, Jump):
            J = operation.J
            if np.delete(J[:, :n] - np.eye(len(J))[:, :n], n, axis=0).any() or J[n, :n].any():
                raise NoSolution("certificate of the gain", "a command acts on the shaft at once")
            rows.append((J @ total)[n] - total[n])
            total = J @ total
    kappa, beta, _, h, share = _rates(ends)
    per_current = 2.0 * beta * h**2 * kappa * (1.0 + beta * h)
    # of friction alone a speed is bent less than a current bends it by a whole period
    speed = share * max(per_current, 2.0 * (beta * h) ** 2)
    return np.array(rows)[:, :k], *_bent(loop, speed)


def _bent(loop: _Moved, speed: float) -> tuple[Array, float]:
    """Return what a departure of the speed by ``speed`` at most makes of state (n,) and error."""
    A, h = loop.model.A, loop.network.period_s
    bend = np.abs(A[:, SPEED]) * h * speed
    bend[0], bend[SPEED] = 0.0, speed
    return bend, abs(float(loop.model.C[SPEED])) * speed * math.sqrt(h)


def _rates(ends: Sequence[_Moved]) -> tuple[float, float, float, float, float]:
    """Return kappa, beta, b, the period, and width^2/8, in units of the lighter end's inverse inertia."""
    light, heavy = ends[-1].model, ends[0].model
    width = 1.0 - float(heavy.B2[SPEED] / light.B2[SPEED])
    A = light.A
    return (
        abs(float(A[SPEED, 0])),
        -float(A[SPEED, SPEED]),
        abs(float(light.B2[SPEED])),
        ends[0].network.period_s,
        width**2 / 8.0,
    )


def _load_is_covered(ends: Sequence[_Moved], P: Sequence[Array], gain: float) -> bool:
    """Return True if the disturbance's part of the departures is within its share of the gain."""
    if len(ends) == 1:
        return True
    _, beta, b, h, share = _rates(ends)
    bend, error = _bent(ends[0], share * 2.0 * beta * h * math.sqrt(h) * b * (1.0 + beta * h))
    n, terms = len(bend), 7
    size = max(float(np.abs(each[:n, :n]).sum(axis=1) @ np.abs(bend) * np.abs(bend).max()) for each in P)
    parts = terms * (1.0 + 1.0 / _EPSILON) * (size + error**2)
    return parts <= gain**2 * _OF_LOAD / (1.0 + _OF_LOAD)
