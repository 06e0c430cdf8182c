"""Figures of a loop whose controller has states, a predictor's or an H-infinity one's.

The other plants are those of every speed loop.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from servobench.design.hinf.margins import Margins

LOST: Final = 5
"""Consecutive samples that a trial loses before the first one after the step."""
CHANGES: Final[Mapping[str, tuple[float, float]]] = {
    "inertia_70_percent": (0.7, 1.0),
    "inertia_130_percent": (1.3, 1.0),
    "current_bandwidth_50_percent": (1.0, 0.5),
}
"""Multiples of the inertia and of the current loop's bandwidth for the other plants."""


@dataclass(frozen=True, slots=True)
class LoopRobustness:
    """Exact figures, except for the peaks, which come from trials without noise."""

    peaks_over_floor: Mapping[str, float]
    """Peaks after the step of the load, as :func:`peaks_over_floor` names them."""
    gain: float
    """L2 gain from load torque to speed error, rad/s per N m, with every sample received."""
    gains: Mapping[str, float]
    """With the plants of :data:`CHANGES`; inf: unstable."""
    bandwidths: tuple[float, float]
    """Range of stable current-loop bandwidths, as shares of its own; by steps of a tenth, down to a half and
    up to twice."""
    margins: Margins
    delay_margin_s: float
    command_noise_nm: float


def peaks_over_floor(ratio: Callable[[float, int], float]) -> dict[str, float]:
    """Name the peaks. ``ratio``: peak over its own floor, for a multiple of the inertia, and for a number of
    samples lost in a row before the first one after the step."""
    return {
        "peak_over_floor": ratio(1.0, 0),
        "peak_over_floor_inertia_70_percent": ratio(0.7, 0),
        "peak_over_floor_inertia_130_percent": ratio(1.3, 0),
        f"peak_over_floor_{LOST}_lost": ratio(1.0, LOST),
    }


def stable_bandwidths(stable: Callable[[float], bool]) -> tuple[float, float]:
    """Return the ``bandwidths`` of a loop that is ``stable`` with the current loop's bandwidth times a
    share."""
    return _last(stable, -0.1, 0.5), _last(stable, 0.1, 2.0)


def _last(stable: Callable[[float], bool], step: float, end: float) -> float:
    reached = 1.0
    while abs(end - reached) > 0.5 * abs(step):
        if not stable(reached + step):
            return reached
        reached += step
    return reached
