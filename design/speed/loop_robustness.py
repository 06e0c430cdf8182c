"""Figures of a loop whose controller has states, a predictor's or an H-infinity one's.

The plants beside the design's are those of every speed loop.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from servobench.design.hinf.margins import Margins

LOST: Final = 5
"""Samples in a row that a trial loses before the first that tells of the step."""
CHANGES: Final[Mapping[str, tuple[float, float]]] = {
    "inertia_70_percent": (0.7, 1.0),
    "inertia_130_percent": (1.3, 1.0),
    "current_bandwidth_50_percent": (1.0, 0.5),
}
"""Times the inertia, and times the bandwidth of the current loop, of plants beside the design's."""


@dataclass(frozen=True, slots=True)
class LoopRobustness:
    """Exact, but for the peaks, which are of trials without noise."""

    peaks_over_floor: Mapping[str, float]
    """After the step of the load, as :func:`peaks_over_floor` names them."""
    gain: float
    """L2 gain from load torque to speed error, rad/s per N m, every sample coming."""
    gains: Mapping[str, float]
    """With the plants of :data:`CHANGES`; inf: unstable."""
    bandwidths: tuple[float, float]
    """Of the current loop, in shares of its own, between which the loop is stable; by steps of a tenth, down
    to a half and up to twice."""
    margins: Margins
    delay_margin_s: float
    command_noise_nm: float


def peaks_over_floor(ratio: Callable[[float, int], float]) -> dict[str, float]:
    """``ratio``: of the peak to its own floor, with so many times the inertia, and with so many samples lost
    in a row before the first that tells of the step."""
    return {
        "peak_over_floor": ratio(1.0, 0),
        "peak_over_floor_inertia_70_percent": ratio(0.7, 0),
        "peak_over_floor_inertia_130_percent": ratio(1.3, 0),
        f"peak_over_floor_{LOST}_lost": ratio(1.0, LOST),
    }


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
