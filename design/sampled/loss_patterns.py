"""Periodic patterns of a network, and a search for the worst of them.

A pattern is a closed walk of :mod:`servobench.design.sampled.admissible_steps`, repeated for ever. Its decay
is a spectral radius, its gain the largest at which the value map of its repetitions stays finite. The search
builds patterns from deliveries, each after any number of losses and at the ends of its delays: all short ones
and all that alternate between two habits, a beam of longer ones, and then changes of single deliveries in the
worst. Its results are admissible: no certificate can be better.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.admissible_steps import Delivery, Family, families, steps_of
from servobench.design.sampled.held_loop import (
    Operation,
    PeriodStep,
    Strategy,
    Switch,
    SwitchedLoop,
    decay_of,
)
from servobench.design.sampled.pattern_chains import (
    Chain,
    Entries,
    Letter,
    alternating,
    by_beam,
    changed,
    padded,
    product_of,
    root_of,
    top_of,
)
from servobench.design.sampled.step_maps import step_maps
from servobench.design.sampled.value_map import ValueMap, largest_product, nothing, stacked

_BEAM = 40
"""Partial patterns kept at each length of the search for the gain."""
_LENGTH_MAX = 6
"""Deliveries in the longest pattern that the beam grows."""
_SLOW_BEAM, _SLOW_LENGTH_MAX = 200, 14
"""The same of the search for the decay, in which a pattern costs a matrix product."""
_WORTHWHILE = 3e-4
"""Relative: a pattern whose gain is higher by less ends the search."""
_CHANGED_MAX = 24
"""Deliveries up to which a pattern is changed delivery by delivery."""
_DOUBLINGS = 16
"""A pattern is repeated two to this power times to decide whether its gain exceeds a level."""
SCORING = 10
"""The same, to rank many."""
_FORGOTTEN = 1e-40
"""Entries of Phi below which the beginning is forgotten: its square changes no digit."""
_BEYOND = 2.0
"""Nearness of a gain that exceeds the level; all others end at 1."""
_LEVELS = 20
"""Parts into which the span of a gain is cut at once."""
_NEAR = 3.0
"""Factor either way around a gain that is searched first."""
_LEAST = 1e-5
"""Multiple of the load's effect in one period: start of the span, and its inverse the end."""
_ROUNDS = 30
"""Rounds of changes to the best pattern."""
_UNEVEN_MAX = 12
"""Periods of a pattern up to which each is tried in several lengths."""
_DELAY_PARTS = (0.0, 0.5, 1.0)
"""Parts of a window at which the instant of a single switching is tried."""
_ENDS = (0.0, 1.0)
"""Parts of windows tried for several switchings."""


@dataclass(frozen=True, slots=True, eq=False)
class _Products:
    """Transition matrices (N, kept, kept) and the time that each takes, s."""

    M: Array
    time_s: Array

    def then(self, following: "_Products") -> "_Products":
        return _Products(following.M @ self.M, self.time_s + following.time_s)

    def __getitem__(self, part: Any) -> "_Products":
        return _Products(self.M[part], self.time_s[part])

    def slowness(self) -> Array:
        """Return minus the decay under the repetition of each, 1/s."""
        radii = np.max(np.abs(np.linalg.eigvals(self.M)), axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(radii) / self.time_s)


@dataclass(frozen=True, slots=True)
class Pattern:
    """Periods that are repeated for ever, and the rate at which the state decays under them, 1/s."""

    steps: tuple[PeriodStep, ...]
    decay_per_s: float


@dataclass(frozen=True, slots=True)
class WorstGain:
    """A pattern, and the gain under it, rad/s per N m; inf: it makes the loop unstable."""

    pattern: Pattern
    gain: float


def repeated(loop: SwitchedLoop, deliveries: Sequence[Delivery]) -> Pattern:
    """Return the pattern of ``deliveries`` with its decay."""
    return pattern_of(loop, steps_of(loop.network, deliveries))


def pattern_of(loop: SwitchedLoop, steps: Sequence[PeriodStep]) -> Pattern:
    """Return the pattern of ``steps`` with its decay."""
    whole_s = sum(loop.network.period_s + step.longer_s for step in steps)
    return Pattern(tuple(steps), decay_of(_transition(loop, steps), whole_s))


def chain_of(loop: SwitchedLoop, pattern: Pattern) -> list[Operation]:
    """Return the operations of one period of ``pattern``."""
    return list(itertools.chain.from_iterable(loop.chain(step) for step in pattern.steps))


def pattern_gains(
    loop: SwitchedLoop, patterns: Sequence[Pattern], tolerance: float = 1e-7, near: float | None = None
) -> Array:
    """Return the gain under each, rad/s per N m, not above it, to the relative ``tolerance``; inf if
    unstable.

    Many levels at once, then between two of them. ``near``: gain at which the search starts, rad/s per N m.
    """
    letters = sorted({letter for each in patterns for letter in _split(each.steps)}, key=repr)
    chains = [tuple(letters.index(letter) for letter in _split(each.steps)) for each in patterns]
    reach = float(np.linalg.norm(loop.model.B2)) * loop.network.period_s
    low, high = np.full(len(patterns), _LEAST * reach), np.full(len(patterns), reach / _LEAST)
    rows, parts = np.arange(len(patterns)), np.arange(1, _LEVELS) / _LEVELS
    while np.max(high / low) > 1.0 + tolerance:
        if near is None:
            levels = low[:, None] * (high / low)[:, None] ** parts
        else:
            levels = near * _NEAR ** (2.0 * parts - 1.0) * np.ones((len(patterns), 1))
            near = None
        maps = letter_maps(loop, [Letter(letter) for letter in letters], levels.ravel())
        bounded = often(_own_product(maps.reshaped((-1, *levels.shape)), chains)).bounded
        lowest = np.where(bounded.any(axis=1), np.argmax(bounded, axis=1), levels.shape[1])
        edges = np.hstack([low[:, None], levels, high[:, None]])
        low, high = edges[rows, lowest], edges[rows, lowest + 1]
    unstable = np.array([each.decay_per_s <= 0.0 for each in patterns])
    return np.where(unstable, math.inf, low)


def _own_product(maps: ValueMap, chains: Sequence[Chain]) -> ValueMap:
    """Concatenate each chain's letters, of maps (letters, chains, levels)."""
    numbers, rows = padded(chains), np.arange(len(chains))
    total = maps[numbers[:, 0], rows]
    for place in range(1, numbers.shape[1]):
        total = total.then(maps[numbers[:, place], rows])
    return total


def _split(steps: Sequence[PeriodStep]) -> list[tuple[PeriodStep, ...]]:
    """Split into groups of periods without a delivery and one with."""
    runs: list[list[PeriodStep]] = [[]]
    for step in steps:
        runs[-1].append(step)
        if step.switches:
            runs.append([])
    return [tuple(each) for each in runs if each]


def slowest_pattern(loop: SwitchedLoop) -> Pattern:
    """Return the periodic pattern of least decay found: it refutes any faster certificate."""
    letters = _letters(loop)
    h = loop.network.period_s
    steps = np.stack([_transition(loop, letter.steps) for letter in letters] + [np.eye(loop.kept)])
    times = np.array([len(letter.steps) * h for letter in letters] + [0.0])
    products = _Products(steps, times)
    best = max(
        top_of(alternating(letters, products), _Products.slowness),
        by_beam(letters, products, _Products.slowness, _SLOW_BEAM, _SLOW_LENGTH_MAX),
        key=lambda each: each[1],
    )
    while len(best[0]) <= _CHANGED_MAX:
        better = top_of(changed(letters, products, best[0]), _Products.slowness)
        if not better[1] > best[1] + 1e-9 * abs(best[1]):
            break
        best = root_of(better[0]), better[1]
    return pattern_of(loop, _steps(letters, best[0]))


def worst_gain(loop: SwitchedLoop, known: Sequence[Pattern], changed_max: int = _CHANGED_MAX) -> WorstGain:
    """Return the pattern of largest gain found, starting from ``known`` ones.

    ``changed_max``: deliveries up to which the best pattern is changed delivery by delivery.
    """
    gains = pattern_gains(loop, known)
    worst = WorstGain(known[int(np.argmax(gains))], float(np.max(gains)))
    if math.isinf(worst.gain):
        return worst
    contest = _Contest(loop, worst.gain)
    contest.enter(alternating(contest.letters, contest.maps))
    contest.enter_beam()
    for _ in range(_ROUNDS):
        if not contest.best or len(contest.best) > changed_max:
            break
        if not contest.enter(changed(contest.letters, contest.maps, contest.best)):
            break
    if contest.best:
        pattern = pattern_of(loop, _steps(contest.letters, contest.best))
        worst = max(
            worst, WorstGain(pattern, float(pattern_gains(loop, [pattern])[0])), key=lambda each: each.gain
        )
    return worst


def with_uneven_periods(loop: SwitchedLoop, known: Pattern) -> list[Pattern]:
    """Return ``known`` with periods of the lengths, each the shortest, the usual or the longest, of largest
    gain and of least decay that single changes find; every sample acts as late as before."""
    found = []
    for by_gain in (True, False):

        def worse(tried: list[Pattern], by_gain: bool = by_gain) -> tuple[float, Pattern]:
            scores = pattern_gains(loop, tried, 1e-5) if by_gain else [-each.decay_per_s for each in tried]
            place = int(np.argmax(scores))
            return float(scores[place]), tried[place]

        best = worse([known])
        uneven_s, count = loop.network.uneven_s, len(known.steps)
        longer = [tuple([by_s] * count) for by_s in (-uneven_s, 0.0, uneven_s)]
        for place in range(-1, count if count <= _UNEVEN_MAX else -1):
            if place >= 0:
                now = tuple(step.longer_s for step in best[1].steps)
                longer = [(*now[:place], by_s, *now[place + 1 :]) for by_s in (-uneven_s, 0.0, uneven_s)]
            best = max(
                best, worse([_lengthened(loop, known, each) for each in longer]), key=lambda each: each[0]
            )
        found.append(best[1])
    return found


def _lengthened(loop: SwitchedLoop, known: Pattern, longer_s: Sequence[float]) -> Pattern:
    """Return ``known`` with periods longer by so much; samples act as long after they were taken."""
    steps = []
    for place, (step, own_s) in enumerate(zip(known.steps, longer_s, strict=True)):
        switches = []
        for switch in step.switches:
            at_s = switch.at_s
            if loop.network.strategy is Strategy.ARRIVAL:
                at_s -= sum(longer_s[(place - back) % len(longer_s)] for back in range(1, switch.back + 1))
                at_s = min(max(at_s, 0.0), loop.network.period_s + own_s)
            switches.append(Switch(switch.back, at_s))
        ordered = sorted(switches, key=lambda each: (each.at_s, -each.back))
        steps.append(PeriodStep(step.source, step.target, tuple(ordered), own_s))
    return pattern_of(loop, steps)


class _Contest:
    """The chain of largest gain so far, and the level, rad/s per N m, that the next must exceed."""

    def __init__(self, loop: SwitchedLoop, level: float) -> None:
        self._loop = loop
        self.letters = _letters(loop)
        self.best: Chain = ()
        self._level = level * (1.0 + _WORTHWHILE)
        self.maps = letter_maps(loop, self.letters, self._level)

    def enter(self, entries: Entries[ValueMap]) -> bool:
        """Enter chains; True if one wins: of those that exceed the level, the last to do so as it rises."""
        chains, total = entries
        survivors = [chains[place] for place in np.flatnonzero(~often(total, SCORING).bounded)]
        if not survivors:
            return False
        share = _WORTHWHILE
        while share > 0.5 * _WORTHWHILE:
            level = self._level * (1.0 + share)
            maps = letter_maps(self._loop, self.letters, level)
            left = np.flatnonzero(~often(product_of(maps, survivors), SCORING).bounded)
            if len(left):
                survivors, self._level, self.maps = [survivors[place] for place in left], level, maps
                share = min(2.0 * share, 1.0)
            else:
                share /= 2.0
        self.best = root_of(survivors[0])
        return True

    def enter_beam(self) -> None:
        """Enter chains grown from those nearest to the level."""
        chain, score = by_beam(self.letters, self.maps, _nearness, _BEAM, _LENGTH_MAX)
        if score >= _BEYOND:
            self.enter(([chain], product_of(self.maps, [chain])))


def often(total: ValueMap, doublings: int = _DOUBLINGS) -> ValueMap:
    """Repeat each two to the power ``doublings`` times, or until its beginning is forgotten."""
    names = ("Phi", "W", "Q", "bounded")
    flat = total.reshaped((-1,))
    repeated = {name: getattr(flat, name).copy() for name in names}
    left = np.arange(total.bounded.size)
    for _ in range(doublings):
        part = flat.then(flat)
        for name in names:
            repeated[name][left] = getattr(part, name)
        moving = np.abs(part.Phi).max(axis=(-2, -1), initial=0.0) > _FORGOTTEN
        flat, left = part[moving], left[moving]
        if not len(left):
            break
    return ValueMap(**repeated).reshaped(total.bounded.shape)


def _nearness(total: ValueMap) -> Array:
    """Return how near each gain is to the level of the maps, from 0 to 1; 2 beyond it."""
    total = often(total, SCORING)
    return np.where(total.bounded, largest_product(total.W, total.Q), _BEYOND)


def letter_maps(loop: SwitchedLoop, letters: Sequence[Letter], gains: ArrayLike) -> ValueMap:
    """Return the value map of each letter at each of ``gains``, and last that of no time at all."""
    steps = sorted({step for letter in letters for step in letter.steps}, key=repr)
    by_step = dict(zip(steps, step_maps(loop, steps, gains), strict=True))
    whole = []
    for letter in letters:
        total = by_step[letter.steps[0]]
        for step in letter.steps[1:]:
            total = total.then(by_step[step])
        whole.append(total)
    whole.append(nothing(whole[0].bounded.shape, loop.kept))
    return stacked(whole)


def _letters(loop: SwitchedLoop) -> list[Letter]:
    by_source: dict[int, list[Family]] = {}
    for family in families(loop.network):
        by_source.setdefault(family.source, []).append(family)
    begins = sorted({family.target for each in by_source.values() for family in each if family.windows})
    return [Letter(steps) for begin in begins for steps in _until_delivery(by_source, begin)]


def _until_delivery(by_source: dict[int, list[Family]], node: int) -> Iterator[tuple[PeriodStep, ...]]:
    for family in by_source[node]:
        if family.windows:
            parts = _DELAY_PARTS if len(family.windows) == 1 else _ENDS
            yield from ((step,) for step in family.over(parts))
        else:
            step = family.at(())
            yield from ((step, *rest) for rest in _until_delivery(by_source, family.target))


def _steps(letters: Sequence[Letter], chain: Chain) -> tuple[PeriodStep, ...]:
    return tuple(itertools.chain.from_iterable(letters[number].steps for number in chain))


def _transition(loop: SwitchedLoop, steps: Sequence[PeriodStep]) -> Array:
    total = np.eye(loop.kept)
    for step in steps:
        total = loop.kept_transition(loop.chain(step)) @ total
    return total
