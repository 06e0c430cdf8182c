"""Figures of a loop whose controller has states: a predictor's, or an H-infinity one's."""

from collections.abc import Callable
from dataclasses import dataclass

from design.hinf.margins import Margins

LOST = 5
"""Samples in a row that a trial loses before the first that tells of the step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopRobustness:
    """Exact, but for the peaks, which are of trials without noise."""

    peak_over_floor: float
    peak_over_floor_inertia_less: float
    peak_over_floor_inertia_more: float
    peak_over_floor_lost: float
    """Of its own floor, with :data:`LOST` samples lost in a row before the first that tells of the step."""
    gain: float
    """L2 gain from load torque to speed error, rad/s per N m, every sample coming."""
    gain_inertia_less: float
    gain_inertia_more: float
    gain_current_loop_slower: float
    """With half the bandwidth; inf: unstable."""
    bandwidths: tuple[float, float]
    """Of the current loop, in shares of its own, between which the loop is stable; by steps of a tenth, down
    to a half and up to twice."""
    margins: Margins
    delay_margin_s: float
    command_noise_nm: float


def stable_bandwidths(stable: Callable[[float], bool]) -> tuple[float, float]:
    """``bandwidths`` of a loop that is ``stable`` with the current loop's bandwidth times a share."""
    return _last(stable, -0.1, 0.5), _last(stable, 0.1, 2.0)


def _last(stable: Callable[[float], bool], step: float, end: float) -> float:
    reached = 1.0
    while abs(end - reached) > 0.5 * abs(step):
        if not stable(reached + step):
            return reached
        reached += step
    return reached
