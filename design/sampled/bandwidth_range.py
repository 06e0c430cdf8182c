"""Range of current-loop bandwidths for which the certificates of a speed loop hold.

From the bandwidth of the design the range grows slice by slice, downwards and upwards. Each slice has its own
certificates, for every bandwidth in it (of the sampled loop :mod:`servobench.design.sampled.step_maps`, of
the one with a constant delay :mod:`servobench.design.delay.delay_norm`); a slice that would raise the
certified gain too far, or cannot be certified, ends the range on its side.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from servobench.design.delay.delay_loop import Array, SpeedModel
from servobench.design.delay.delay_norm import norm_between
from servobench.design.errors import NoSolution
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork
from servobench.design.sampled.loss_patterns import Pattern, pattern_gains, pattern_of
from servobench.design.sampled.sequence_certificate import certify_decay, certify_gain

_SLICE = 1.08
"""Upper over lower end of a slice."""
_WIDEST = 1.6
"""End of the range over the bandwidth of the design, either way."""
_ALLOWED = 1.1
"""Limit of a slice's certified gain over that of the design: a larger range would be of no use."""

ModelAt = Callable[[float], SpeedModel]
"""The model with a current loop of so many Hz."""
Figures = tuple[float, float | None]
"""Certified gain and decay; None: the decay is not computed."""


@dataclass(frozen=True, slots=True)
class BandwidthRange:
    """From ``min_hz`` to ``max_hz`` gain, rad/s per N m, and decay, 1/s, are certified."""

    min_hz: float
    max_hz: float
    gain: float
    decay_per_s: float | None = None
    """None: with a constant delay, where only the gain is certified."""


def bandwidth_range(
    model_at: ModelAt, K: Array, network: SampledNetwork, patterns: list[Pattern], nominal: BandwidthRange
) -> BandwidthRange:
    """Return the range of the sampled loop around ``nominal``, whose ends are the bandwidth of the design.

    ``patterns``: the worst ones known there.
    """

    def figures(one_hz: float, other_hz: float) -> Figures | None:
        one, other = (HeldLoop(model_at(each), K, network) for each in (one_hz, other_hz))
        return _sampled(one, other, patterns)

    return _grown(nominal, figures)


def constant_bandwidth_range(
    model_at: ModelAt, K: Array, delay_s: float, nominal: BandwidthRange
) -> BandwidthRange:
    """Return the range of the loop with the constant delay."""

    def figures(one_hz: float, other_hz: float) -> Figures | None:
        gain = norm_between(*(model_at(each).loop(K, delay_s) for each in (one_hz, other_hz)))
        return None if math.isinf(gain) else (gain, None)

    return _grown(nominal, figures)


def _grown(nominal: BandwidthRange, figures: Callable[[float, float], Figures | None]) -> BandwidthRange:
    """Grow the range. ``figures``: certified for every bandwidth between two."""
    grown = nominal
    for factor in (1.0 / _SLICE, _SLICE):
        end_hz = nominal.min_hz
        while nominal.min_hz / _WIDEST < end_hz * factor < nominal.min_hz * _WIDEST:
            certified = figures(end_hz, end_hz * factor)
            if certified is None or certified[0] > _ALLOWED * nominal.gain:
                break
            end_hz *= factor
            decays = [each for each in (grown.decay_per_s, certified[1]) if each is not None]
            grown = BandwidthRange(
                min(grown.min_hz, end_hz),
                max(grown.max_hz, end_hz),
                max(grown.gain, certified[0]),
                min(decays, default=None),
            )
    return grown


def _sampled(one: HeldLoop, other: HeldLoop, known: list[Pattern]) -> Figures | None:
    """Return certified gain and decay for every bandwidth between the two loops'."""
    patterns = [pattern_of(one, each.steps) for each in known]
    gain = float(max(pattern_gains(one, patterns, 1e-3)))
    if min(each.decay_per_s for each in patterns) <= 0.0:
        return None
    try:
        gain_proof = certify_gain(one, patterns, gain, other=other)
        decay_proof = certify_decay(one, patterns, gain, (0,), other)
    except NoSolution:
        return None
    if gain_proof is None or decay_proof is None:
        return None
    return (gain_proof.figure, decay_proof.figure) if decay_proof.figure > 0.0 else None
