"""Periodic patterns of a network, and the worst of them that a search finds.

A pattern is a closed walk of :mod:`design.admissible_steps`, repeated for ever. Its decay is a spectral
radius, its gain the largest at which the value map of its repetitions stays finite. The search puts
patterns together from deliveries, each after as many losses as may be and at the ends of its delays:
all short ones and all that alternate between two habits, a beam of longer ones, and then changes of
single deliveries in the worst. What it finds is admissible: no certificate can be better.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from design.admissible_steps import Delivery, Family, deliveries_of, families, steps_of
from design.delay_loop import Array
from design.held_loop import HeldLoop, Operation, PeriodStep, decay_of
from design.step_maps import step_maps
from design.value_map import ValueMap, largest_product, nothing

_BEAM = 40
"""Partial patterns kept at each length of the search for the gain."""
_LENGTH_MAX = 6
"""Deliveries in the longest pattern that the beam grows."""
_SLOW_BEAM, _SLOW_LENGTH_MAX = 200, 14
"""The same of the search for the decay, in which a pattern costs a matrix product."""
_WORTHWHILE = 3e-4
"""Relative: a pattern whose gain is higher by less ends the search."""
_OFTEN = (1, 2, 3, 4, 6, 8, 12)
_SELDOM = (1, 2, 3)
"""How often two deliveries alternate: so many of the one, then so many of the other."""
_CHANGED_MAX = 24
"""Deliveries up to which a pattern is changed delivery by delivery."""
_DOUBLINGS = 16
"""A pattern is repeated two to this power times to tell whether its gain exceeds a level."""
_SCORING = 10
"""The same, to rank many."""
_BEYOND = 2.0
_LEVELS = 20
"""Parts into which the span of a gain is cut at once."""
_NEAR = 3.0
"""Factor either way of a gain about which is looked first."""
_LEAST = 1e-5
"""Times what the load does in one period: where the span begins, and its inverse where it ends."""
_ROUNDS = 30
"""Of changes of the best."""
_DELAY_PARTS = (0.0, 0.5, 1.0)
"""Of a window, where the moment of a single switching is tried; several are tried at the ends."""


Chain = tuple[int, ...]
"""Letters, by number."""


class _Stretches(Protocol):
    """Stretches of time, many at once, that can be put one after the other."""

    def then(self, following: Self) -> Self: ...

    def __getitem__(self, part: Any) -> Self: ...


_Total = TypeVar("_Total", bound=_Stretches)
_Entries = tuple[list[Chain], _Total]


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
        """Minus the decay under the repetition of each, 1/s."""
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


@dataclass(frozen=True, slots=True)
class _Letter:
    """Periods without a delivery, and one with."""

    steps: tuple[PeriodStep, ...]

    @property
    def source(self) -> int:
        return self.steps[0].source

    @property
    def target(self) -> int:
        return self.steps[-1].target


def repeated(loop: HeldLoop, deliveries: Sequence[Delivery]) -> Pattern:
    """The pattern of ``deliveries`` with its decay."""
    return pattern_of(loop, steps_of(loop.network, deliveries))


def pattern_of(loop: HeldLoop, steps: Sequence[PeriodStep]) -> Pattern:
    """The pattern of ``steps`` with its decay."""
    total = np.eye(loop.kept)
    for step in steps:
        total = loop.kept_transition(loop.chain(step)) @ total
    return Pattern(tuple(steps), decay_of(total, len(steps) * loop.network.period_s))


def chain_of(loop: HeldLoop, pattern: Pattern) -> list[Operation]:
    """The operations of one period of ``pattern``."""
    return list(itertools.chain.from_iterable(loop.chain(step) for step in pattern.steps))


def named_deliveries(loop: HeldLoop, pattern: Pattern) -> tuple[Delivery, ...]:
    """The deliveries of ``pattern``."""
    return deliveries_of(loop.network, pattern.steps)


def pattern_gain(loop: HeldLoop, pattern: Pattern) -> float:
    """Gain under ``pattern``, rad/s per N m, not above it; inf if unstable."""
    return float(pattern_gains(loop, [pattern])[0])


def pattern_gains(
    loop: HeldLoop, patterns: Sequence[Pattern], tolerance: float = 1e-7, near: float | None = None
) -> Array:
    """The same of each, to the relative ``tolerance``: many levels at once, then between two of them.

    ``near``: about which gain to look first, rad/s per N m.
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
        maps = _letter_maps(loop, [_Letter(letter) for letter in letters], levels.ravel())
        bounded = _often(_own_product(maps.reshaped((-1, *levels.shape)), chains)).bounded
        lowest = np.where(bounded.any(axis=1), np.argmax(bounded, axis=1), levels.shape[1])
        edges = np.hstack([low[:, None], levels, high[:, None]])
        low, high = edges[rows, lowest], edges[rows, lowest + 1]
    unstable = np.array([each.decay_per_s <= 0.0 for each in patterns])
    return np.where(unstable, math.inf, low)


def _own_product(maps: ValueMap, chains: Sequence[Chain]) -> ValueMap:
    """Each chain's letters one after the other, of maps (letters, chains, levels)."""
    padded, rows = _padded(chains), np.arange(len(chains))
    total = maps[padded[:, 0], rows]
    for place in range(1, padded.shape[1]):
        total = total.then(maps[padded[:, place], rows])
    return total


def _split(steps: Sequence[PeriodStep]) -> list[tuple[PeriodStep, ...]]:
    """Periods without a delivery and one with, as often as there is one."""
    found: list[list[PeriodStep]] = [[]]
    for step in steps:
        found[-1].append(step)
        if step.switches:
            found.append([])
    return [tuple(each) for each in found if each]


def slowest_pattern(loop: HeldLoop) -> Pattern:
    """The periodic pattern of least decay that the search finds: a refutation of any faster certificate."""
    letters = _letters(loop)
    h = loop.network.period_s
    steps = np.stack([_transition(loop, letter) for letter in letters] + [np.eye(loop.kept)])
    times = np.array([len(letter.steps) * h for letter in letters] + [0.0])
    products = _Products(steps, times)
    best = max(
        _top(_alternating(letters, products), _Products.slowness),
        _by_beam(letters, products, _Products.slowness, _SLOW_BEAM, _SLOW_LENGTH_MAX),
        key=lambda found: found[1],
    )
    while len(best[0]) <= _CHANGED_MAX:
        better = _top(_changed(letters, products, best[0]), _Products.slowness)
        if not better[1] > best[1] + 1e-9 * abs(best[1]):
            break
        best = _root(better[0]), better[1]
    return pattern_of(loop, _steps(letters, best[0]))


def worst_gain(loop: HeldLoop, known: Sequence[Pattern], changed_max: int = _CHANGED_MAX) -> WorstGain:
    """The pattern of largest gain that the search finds, from ``known`` ones.

    ``changed_max``: deliveries up to which the best pattern is changed delivery by delivery.
    """
    gains = pattern_gains(loop, known)
    found = WorstGain(known[int(np.argmax(gains))], float(np.max(gains)))
    if math.isinf(found.gain):
        return found
    contest = _Contest(loop, found.gain)
    contest.enter(_alternating(contest.letters, contest.maps))
    contest.enter_beam()
    for _ in range(_ROUNDS):
        if not contest.best or len(contest.best) > changed_max:
            break
        if not contest.enter(_changed(contest.letters, contest.maps, contest.best)):
            break
    if contest.best:
        pattern = pattern_of(loop, _steps(contest.letters, contest.best))
        found = max(found, WorstGain(pattern, pattern_gain(loop, pattern)), key=lambda each: each.gain)
    return found


class _Contest:
    """The chain of largest gain so far, and the level, rad/s per N m, that the next must exceed."""

    def __init__(self, loop: HeldLoop, level: float) -> None:
        self._loop = loop
        self.letters = _letters(loop)
        self.best: Chain = ()
        self._level = level * (1.0 + _WORTHWHILE)
        self.maps = _letter_maps(loop, self.letters, self._level)

    def enter(self, entries: "_Entries[ValueMap]") -> bool:
        """Whether one of them wins: of those that exceed the level the last that does so as it rises."""
        chains, total = entries
        survivors = [chains[place] for place in np.flatnonzero(~_often(total, _SCORING).bounded)]
        if not survivors:
            return False
        share = _WORTHWHILE
        while share > 0.5 * _WORTHWHILE:
            level = self._level * (1.0 + share)
            maps = _letter_maps(self._loop, self.letters, level)
            left = np.flatnonzero(~_often(_product(maps, survivors), _SCORING).bounded)
            if len(left):
                survivors, self._level, self.maps = [survivors[place] for place in left], level, maps
                share = min(2.0 * share, 1.0)
            else:
                share /= 2.0
        self.best = _root(survivors[0])
        return True

    def enter_beam(self) -> None:
        """Chains that grow from those that come nearest to the level."""
        chain, score = _by_beam(self.letters, self.maps, _nearness, _BEAM, _LENGTH_MAX)
        if score >= _BEYOND:
            self.enter(([chain], _product(self.maps, [chain])))


def _often(total: ValueMap, doublings: int = _DOUBLINGS) -> ValueMap:
    for _ in range(doublings):
        total = total.then(total)
    return total


def _nearness(total: ValueMap) -> Array:
    """How near each gain is to the level of the maps, from 0 to 1; beyond that 2."""
    total = _often(total, _SCORING)
    return np.where(total.bounded, largest_product(total.W, total.Q), _BEYOND)


def _letter_maps(loop: HeldLoop, letters: Sequence[_Letter], gains: ArrayLike) -> ValueMap:
    """The value map of each letter at each of ``gains``, and last that of no time at all."""
    steps = sorted({step for letter in letters for step in letter.steps}, key=repr)
    by_step = dict(zip(steps, step_maps(loop, steps, gains), strict=True))
    whole = []
    for letter in letters:
        total = by_step[letter.steps[0]]
        for step in letter.steps[1:]:
            total = total.then(by_step[step])
        whole.append(total)
    whole.append(nothing(whole[0].bounded.shape, loop.kept))
    return ValueMap(
        *(np.stack([getattr(each, part) for each in whole]) for part in ("Phi", "W", "Q", "bounded"))
    )


def _letters(loop: HeldLoop) -> list[_Letter]:
    by_source: dict[int, list[Family]] = {}
    for family in families(loop.network):
        by_source.setdefault(family.source, []).append(family)
    begins = sorted({family.target for each in by_source.values() for family in each if family.windows})
    return [_Letter(steps) for begin in begins for steps in _until_delivery(by_source, begin)]


def _until_delivery(by_source: dict[int, list[Family]], node: int) -> Iterator[tuple[PeriodStep, ...]]:
    for family in by_source[node]:
        if family.windows:
            yield from ((step,) for step in _extremes(family))
        else:
            step = family.at(())
            yield from ((step, *rest) for rest in _until_delivery(by_source, family.target))


def _extremes(family: Family) -> Iterator[PeriodStep]:
    parts = _DELAY_PARTS if len(family.windows) == 1 else (0.0, 1.0)
    tried = [
        sorted({window.first_s + part * (window.last_s - window.first_s) for part in parts})
        for window in family.windows
    ]
    for times in itertools.product(*tried):
        if all(earlier <= later for earlier, later in itertools.pairwise(times)):
            yield family.at(times)


def _steps(letters: Sequence[_Letter], chain: Chain) -> tuple[PeriodStep, ...]:
    return tuple(itertools.chain.from_iterable(letters[number].steps for number in chain))


def _root(chain: Chain) -> Chain:
    """The chain that ``chain`` repeats."""
    lengths = (length for length in range(1, len(chain) + 1) if len(chain) % length == 0)
    return next(chain[:k] for k in lengths if chain[:k] * (len(chain) // k) == chain)


def _top(entries: "_Entries[_Total]", score: Callable[[_Total], Array]) -> tuple[Chain, float]:
    chains, total = entries
    if not chains:
        return (), -math.inf
    scores = score(total)
    top = int(np.argmax(scores))
    return chains[top], float(scores[top])


def _product(maps: _Total, chains: Sequence[Chain]) -> _Total:
    """Each chain's letters one after the other; the last letter, -1, lasts no time."""
    padded = _padded(chains)
    total = maps[padded[:, 0]]
    for place in range(1, padded.shape[1]):
        total = total.then(maps[padded[:, place]])
    return total


def _padded(chains: Sequence[Chain]) -> NDArray[np.int64]:
    """(N, length) letters; -1, the last one, after a chain's end."""
    padded = np.full((len(chains), max(map(len, chains))), -1)
    for row, chain in enumerate(chains):
        padded[row, : len(chain)] = chain
    return padded


def _alternating(letters: Sequence[_Letter], maps: _Total) -> "_Entries[_Total]":
    """One delivery for ever, or so many of the one and then so many of the other."""
    loops = [number for number, letter in enumerate(letters) if letter.source == letter.target]
    chains: list[Chain] = [(number,) for number in loops]
    for one, other in itertools.permutations(loops, 2):
        if letters[one].source == letters[other].source:
            chains += [
                (*itertools.repeat(one, often), *itertools.repeat(other, seldom))
                for often in _OFTEN
                for seldom in _SELDOM
                if seldom <= often
            ]
    return chains, _product(maps, chains) if chains else maps[:0]


def _by_beam(
    letters: Sequence[_Letter], maps: _Total, score: Callable[[_Total], Array], beam: int, length_max: int
) -> tuple[Chain, float]:
    """Every chain of one and two letters; longer ones grow from those of highest score."""
    chains: list[Chain] = [(number,) for number in range(len(letters))]
    best: tuple[Chain, float] = (), -math.inf
    for _ in range(length_max):
        scores = score(_product(maps, chains))
        order = np.argsort(-scores, kind="stable")
        closed = (place for place in order if _is_closed(letters, chains[place]))
        first = next(closed, None)
        # a longer pattern that only repeats a shorter one, up to rounding, does not replace it
        if first is not None and (not best[0] or scores[first] > best[1] + 1e-9 * abs(best[1])):
            best = chains[first], float(scores[first])
        kept = order if len(order) <= len(letters) else order[:beam]
        chains = _longer(letters, [chains[place] for place in kept])
    return best


def _longer(letters: Sequence[_Letter], chains: Sequence[Chain]) -> list[Chain]:
    """Every chain with every letter that may follow it, one of each set of rotations."""
    found: dict[Chain, Chain] = {}
    for chain in chains:
        for number, letter in enumerate(letters):
            if letter.source == letters[chain[-1]].target:
                longer = (*chain, number)
                closed = letter.target == letters[chain[0]].source
                least = min(longer[k:] + longer[:k] for k in range(len(longer))) if closed else longer
                found.setdefault(least, longer)
    return list(found.values())


def _changed(letters: Sequence[_Letter], maps: _Total, chain: Chain) -> "_Entries[_Total]":
    """``chain`` with a letter more, less, or another, as far as it stays a closed walk."""
    found: list[tuple[Chain, int, int, int]] = []
    length, none = len(chain), len(letters)
    for place in range(length):
        tried = [(chain[:place] + chain[place + 1 :], place, none, place + 1)]
        for number in range(len(letters)):
            tried.append(((*chain[:place], number, *chain[place:]), place, number, place))
            tried.append(((*chain[:place], number, *chain[place + 1 :]), place, number, place + 1))
        found += [each for each in tried if each[0] and each[0] != chain and _is_closed(letters, each[0])]
    if not found:
        return [], maps[:0]
    before = _product(maps, [chain[:place] or (none,) for place in range(length + 1)])
    after = _product(maps, [chain[place:] or (none,) for place in range(length + 1)])
    firsts, middles, lasts = (np.array([each[part] for each in found]) for part in (1, 2, 3))
    return [each[0] for each in found], before[firsts].then(maps[middles]).then(after[lasts])


def _is_closed(letters: Sequence[_Letter], chain: Chain) -> bool:
    return all(
        letters[before].target == letters[after].source
        for before, after in zip(chain, (*chain[1:], chain[0]), strict=True)
    )


def _transition(loop: HeldLoop, letter: _Letter) -> Array:
    total = np.eye(loop.kept)
    for step in letter.steps:
        total = loop.kept_transition(loop.chain(step)) @ total
    return total
