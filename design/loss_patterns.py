"""What the network can do to a sampled loop, from delivery to delivery, and the worst of it that is found.

A delivery is a sample that came after some delay, and the number of periods to the next one that comes.
Any sequence of deliveries with intervals 1 .. D + 1 and delays 0 .. T is admissible. A sequence that is
repeated for ever is a periodic pattern: its transition matrix is a product, its decay a spectral radius.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from design.delay_loop import Array
from design.held_loop import Delivery, HeldLoop, Operation, Strategy, decay_of

_DELAYS_TRIED = 5
"""From 0 to T, for the delays of a searched pattern."""
_BEAM = 60
"""Partial patterns kept at each length of the search."""
_LENGTH_MAX = 6
"""Deliveries in the longest pattern that is searched."""


@dataclass(frozen=True, slots=True)
class Pattern:
    """Deliveries that are repeated for ever, and the rate at which the state decays under them, 1/s."""

    deliveries: tuple[Delivery, ...]
    decay_per_s: float

    def duration_s(self, period_s: float) -> float:
        """Time from its begin to its repetition."""
        return period_s * sum(delivery.interval for delivery in self.deliveries)


def deliveries_of(loop: HeldLoop, delays: int = _DELAYS_TRIED) -> list[Delivery]:
    """Every interval with a choice of ``delays`` delays from 0 to T, where the delay makes a difference."""
    network = loop.network
    if network.strategy is Strategy.HISTORY:
        return [Delivery(1, network.delay_max_s)]
    intervals = range(1, network.losses_max + 2)
    if network.strategy is Strategy.STAMP:
        return [Delivery(interval, network.delay_max_s) for interval in intervals]
    tried = sorted(set(np.linspace(0.0, network.delay_max_s, delays).tolist()))
    return [Delivery(interval, delay) for interval in intervals for delay in tried]


def repeated(loop: HeldLoop, deliveries: tuple[Delivery, ...]) -> Pattern:
    """The pattern of ``deliveries`` with its decay."""
    total = np.eye(loop.kept)
    for delivery in deliveries:
        total = loop.kept_transition(loop.step(delivery)) @ total
    intervals = sum(delivery.interval for delivery in deliveries)
    return Pattern(deliveries, decay_of(total, intervals * loop.network.period_s))


def chain_of(loop: HeldLoop, pattern: Pattern) -> list[Operation]:
    """The operations of one period of ``pattern``."""
    return list(itertools.chain.from_iterable(loop.step(delivery) for delivery in pattern.deliveries))


def worst_pattern(loop: HeldLoop, length_max: int = _LENGTH_MAX, beam: int = _BEAM) -> Pattern:
    """The periodic pattern of least decay that a beam search finds: a refutation of any faster certificate.

    All patterns of one and two deliveries are tried; longer ones grow from those of least decay so far.
    """
    choices = deliveries_of(loop)
    steps = [loop.kept_transition(loop.step(choice)) for choice in choices]
    times = np.array([choice.interval for choice in choices]) * loop.network.period_s
    products: Array = np.stack(steps)
    chains: list[tuple[int, ...]] = [(number,) for number in range(len(choices))]
    least, worst = np.inf, chains[0]
    for _ in range(length_max):
        spent = np.array([times[list(chain)].sum() for chain in chains])
        radii = np.max(np.abs(np.linalg.eigvals(products)), axis=1)
        with np.errstate(divide="ignore"):
            decays = -np.log(radii) / spent
        order = np.argsort(decays, kind="stable")
        # A longer pattern that only repeats a shorter one, up to rounding, does not replace it.
        if least == np.inf or decays[order[0]] < least - 1e-9 * abs(least):
            least, worst = float(decays[order[0]]), chains[order[0]]
        kept = order if len(order) <= len(choices) else order[:beam]
        chains, products = _longer([chains[k] for k in kept], products[kept], steps)
    return repeated(loop, tuple(choices[number] for number in worst))


def _longer(
    chains: list[tuple[int, ...]], products: Array, steps: list[Array]
) -> tuple[list[tuple[int, ...]], Array]:
    """Every chain with every step after it, one of each set of rotations."""
    seen: set[tuple[int, ...]] = set()
    found: list[tuple[int, ...]] = []
    matrices = []
    for chain, product in zip(chains, products, strict=True):
        for number, step in enumerate(steps):
            longer = (*chain, number)
            least = min(longer[k:] + longer[:k] for k in range(len(longer)))
            if least not in seen:
                seen.add(least)
                found.append(longer)
                matrices.append(step @ product)
    return found, np.stack(matrices)
