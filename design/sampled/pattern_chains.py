"""Chains of deliveries, the building blocks of patterns, tried many at once.

A chain is a row of letters, each some periods without a delivery and one with. The effect of a chain is the
product of its letters' effects (:class:`Stretches`): transition matrices for the decay, value maps for the
gain.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.held_loop import PeriodStep

_OFTEN = (1, 2, 3, 4, 6, 8, 12)
_SELDOM = (1, 2, 3)
"""Alternation of two deliveries: repetitions of the first, then of the second."""

Chain = tuple[int, ...]
"""Letters, by number."""


class Stretches(Protocol):
    """Stretches of time, many at once, that can be concatenated."""

    def then(self, following: Self) -> Self: ...

    def __getitem__(self, part: Any) -> Self: ...


Total = TypeVar("Total", bound=Stretches)
Entries = tuple[list[Chain], Total]


@dataclass(frozen=True, slots=True)
class Letter:
    """Periods without a delivery, and one with."""

    steps: tuple[PeriodStep, ...]

    @property
    def source(self) -> int:
        return self.steps[0].source

    @property
    def target(self) -> int:
        return self.steps[-1].target


def root_of(chain: Chain) -> Chain:
    """Return the chain that ``chain`` repeats."""
    lengths = (length for length in range(1, len(chain) + 1) if len(chain) % length == 0)
    return next(chain[:k] for k in lengths if chain[:k] * (len(chain) // k) == chain)


def top_of(entries: Entries[Total], score: Callable[[Total], Array]) -> tuple[Chain, float]:
    """Return the chain of highest score, and that score."""
    chains, total = entries
    if not chains:
        return (), -math.inf
    scores = score(total)
    top = int(np.argmax(scores))
    return chains[top], float(scores[top])


def product_of(maps: Total, chains: Sequence[Chain]) -> Total:
    """Concatenate each chain's letters; the last letter, -1, lasts no time."""
    numbers = padded(chains)
    total = maps[numbers[:, 0]]
    for place in range(1, numbers.shape[1]):
        total = total.then(maps[numbers[:, place]])
    return total


def padded(chains: Sequence[Chain]) -> NDArray[np.int64]:
    """Return (N, length) letters; -1, the last one, after a chain's end."""
    padded = np.full((len(chains), max(map(len, chains))), -1)
    for row, chain in enumerate(chains):
        padded[row, : len(chain)] = chain
    return padded


def alternating(letters: Sequence[Letter], maps: Total) -> Entries[Total]:
    """Return chains of one delivery for ever, or of repetitions of one and then of another."""
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
    return chains, product_of(maps, chains) if chains else maps[:0]


def by_beam(
    letters: Sequence[Letter], maps: Total, score: Callable[[Total], Array], beam: int, length_max: int
) -> tuple[Chain, float]:
    """Try every chain of one and two letters; grow longer ones from those of highest score."""
    chains: list[Chain] = [(number,) for number in range(len(letters))]
    best: tuple[Chain, float] = (), -math.inf
    for _ in range(length_max):
        scores = score(product_of(maps, chains))
        order = np.argsort(-scores, kind="stable")
        closed = (place for place in order if _is_closed(letters, chains[place]))
        first = next(closed, None)
        # a longer pattern that only repeats a shorter one, up to rounding, does not replace it
        if first is not None and (not best[0] or scores[first] > best[1] + 1e-9 * abs(best[1])):
            best = chains[first], float(scores[first])
        kept = order if len(order) <= len(letters) else order[:beam]
        chains = _longer(letters, [chains[place] for place in kept])
    return best


def _longer(letters: Sequence[Letter], chains: Sequence[Chain]) -> list[Chain]:
    """Return every chain with every letter that may follow it, one of each set of rotations."""
    one_of_each: dict[Chain, Chain] = {}
    for chain in chains:
        for number, letter in enumerate(letters):
            if letter.source == letters[chain[-1]].target:
                longer = (*chain, number)
                closed = letter.target == letters[chain[0]].source
                least = min(longer[k:] + longer[:k] for k in range(len(longer))) if closed else longer
                one_of_each.setdefault(least, longer)
    return list(one_of_each.values())


def changed(letters: Sequence[Letter], maps: Total, chain: Chain) -> Entries[Total]:
    """Return ``chain`` with a letter more, less, or another, as long as it is a closed walk."""
    variants: list[tuple[Chain, int, int, int]] = []
    length, none = len(chain), len(letters)
    for place in range(length):
        tried = [(chain[:place] + chain[place + 1 :], place, none, place + 1)]
        for number in range(len(letters)):
            tried.append(((*chain[:place], number, *chain[place:]), place, number, place))
            tried.append(((*chain[:place], number, *chain[place + 1 :]), place, number, place + 1))
        variants += [each for each in tried if each[0] and each[0] != chain and _is_closed(letters, each[0])]
    if not variants:
        return [], maps[:0]
    before = product_of(maps, [chain[:place] or (none,) for place in range(length + 1)])
    after = product_of(maps, [chain[place:] or (none,) for place in range(length + 1)])
    firsts, middles, lasts = (np.array([each[part] for each in variants]) for part in (1, 2, 3))
    return [each[0] for each in variants], before[firsts].then(maps[middles]).then(after[lasts])


def _is_closed(letters: Sequence[Letter], chain: Chain) -> bool:
    return all(
        letters[before].target == letters[after].source
        for before, after in zip(chain, (*chain[1:], chain[0]), strict=True)
    )
