"""By what the pages of a run that has ended are scaled, and what its signals are held against."""

from collections.abc import Callable, Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np

from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.drivers.timebase import NS_PER_US
from servobench.hil.recording.page_series import torque_scale
from servobench.hil.recording.plot_scale import Range, about, around_zero
from servobench.hil.reviewing.envelope import Envelope, Points
from servobench.hil.reviewing.review import Review
from servobench.hil.reviewing.tracking_error import (
    Stretch,
    limit_points,
    position_stretches,
    speed_limits,
    speed_stretches,
)
from servobench.hil.rows.recording_plan import RecordingPlan

_WORTH_SHOWING: Final = 4.0
"""A limit so many times the signal, or farther, would flatten it: the title names it then."""
COUNTED_SHARE: Final = 0.98
"""Share of the counted error that is shown: what a fault of a few cycles does beyond it does not flatten the
rest."""
_NEARLY_REACHED: Final = 1.2
"""A limit of the drive that is farther from its signal is said in the title alone."""
_DRAWN: Final = {
    "speed": ("speed/measured", "speed/reference"),
    "torque": ("torque/measured", "torque/command", "torque/load", "torque/brake"),
    "position": ("position/measured", "position/reference"),
}
_MARGIN: Final = 1.15
"""Bars end below the frame, with room for the label above the largest."""


def in_view(limit: float, signal: float) -> bool:
    """Return True if a limit is shown beside a signal that reaches to ``signal``."""
    return limit <= _WORTH_SHOWING * signal


class _Limit(NamedTuple):
    """Limits of a plot, up and down, in the plot's unit."""

    plot: str
    size: float | None
    """The largest one in the picture; None: nobody says."""
    reach: float
    """How far the signal comes; of an error what counts of it."""
    drawn: bool
    """It is near enough to its signal to be a line."""
    title: str
    scale: float
    """By what a size of ``held`` is multiplied to be drawn."""
    held: Callable[[int, int], list[Stretch]]
    """Where it holds between two instants, ns."""


class WholeFigures:
    """Figures of one run."""

    def __init__(self, plan: RecordingPlan, envelopes: Mapping[str, Envelope], review: Review) -> None:
        """``envelopes``: by the path of the series."""
        self._envelopes = envelopes
        self._deadline_us = plan.deadline / NS_PER_US
        self._limits = {
            axis.name: self._of_axis(plan, review, place) for place, axis in enumerate(plan.review.axes)
        }

    def ranges(self) -> dict[str, Range]:
        """Return the ranges of the values, by axis and plot; a plot without one is as wide as its data."""
        ranges: dict[str, Range] = {}
        for name, limits in self._limits.items():
            plots = {plot: about(self._ends(name, *paths)) for plot, paths in _DRAWN.items()}
            plots["delay"] = self._delay_range(name)
            plots |= {each.plot: _error_range(each) for each in limits if each.plot not in _DRAWN}
            for plot, low_high in plots.items():
                if low_high is not None and low_high[0] < low_high[1]:
                    ranges[f"{name}/{plot}"] = low_high
        return ranges

    def remarks(self) -> dict[str, str]:
        """Return remarks for the plots' titles on limits outside the picture, by axis and plot."""
        remarks: dict[str, str] = {}
        for name, limits in self._limits.items():
            remarks |= {f"{name}/{each.plot}": f" · limit ±{each.title}" for each in limits if each.title}
            remarks[f"{name}/delay"] = f" · deadline {self._deadline_us:.0f}"
            remarks[f"{name}/histogram"] = f", deadline {self._deadline_us:.0f}"
        return remarks

    def limit_lines(self, begin: int, end: int) -> dict[str, Points]:
        """By the path of the line, instants and values; those that are in the picture."""
        lines: dict[str, Points] = {}
        for name, limits in self._limits.items():
            if in_view(self._deadline_us, self._reach(name, "delay/delay")):
                lines[f"/{name}/delay/deadline"] = np.array([begin, end]), np.full(2, self._deadline_us)
            for each in limits:
                if each.size is not None and each.drawn:
                    held = each.held(begin, end)
                    lines[f"/{name}/{each.plot}/most"] = limit_points(held, each.scale)
                    lines[f"/{name}/{each.plot}/least"] = limit_points(held, -each.scale)
        return lines

    def _of_axis(self, plan: RecordingPlan, review: Review, place: int) -> list[_Limit]:
        axis, limits = plan.review.axes[place], plan.review.limits
        speed, position = review.errors[place], review.positions[place]
        held = [
            _of_error(
                "error",
                RPM_PER_RAD_S,
                speed.counted,
                speed_limits(speed, limits),
                lambda begin, end: speed_stretches(speed, limits, begin, end),
            ),
            _of_error(
                "position_error",
                1.0,
                position.counted,
                {"": limits.position_error_peak_rad_max},
                lambda begin, end: position_stretches(position, limits, begin, end),
            ),
        ]
        of_drive = (
            ("torque", axis.torque_max_nm, torque_scale(axis)[0]),
            ("speed", axis.speed_max_rad_s, RPM_PER_RAD_S),
        )
        for plot, most, scale in of_drive:
            if most is not None:
                reach = self._reach(axis.name, *_DRAWN[plot])
                near = scale * most <= _NEARLY_REACHED * reach
                title = f"{scale * most:.0f}"
                held.append(_Limit(plot, scale * most, reach, near, title, scale, _throughout(most)))
        return held

    def _reach(self, name: str, *paths: str) -> float:
        """The largest by size."""
        return max((abs(value) for value in self._ends(name, *paths)), default=0.0)

    def _ends(self, name: str, *paths: str) -> Iterator[float]:
        for path in paths:
            envelope = self._envelopes.get(f"/{name}/{path}")
            if envelope is not None and (ends := envelope.ends()) is not None:
                yield from ends

    def _delay_range(self, name: str) -> Range | None:
        """From 0, or from where a drive's clock was wrong, with the deadline, if that is near."""
        values = list(self._ends(name, "delay/delay"))
        if not values:
            return None
        top = max(values)
        if in_view(self._deadline_us, top):
            top = max(top, self._deadline_us)
        return min(-0.08 * top, _MARGIN * min(values)), _MARGIN * top


def _error_range(error: _Limit) -> Range | None:
    """Return a range as wide as the error that counts, not as a step's first instant; with a limit that is
    near."""
    reach = max(error.reach, error.size or 0.0) if error.drawn else error.reach
    return around_zero(reach) if reach else None


def _counted_reach(counted: Envelope) -> float:
    """The peak of an error that counts, but no more than some times what nearly all of it keeps."""
    peak, most = counted.largest(), counted.largest(COUNTED_SHARE)
    return 0.0 if peak is None or most is None else min(peak, _WORTH_SHOWING * most or peak)


def _of_error(
    plot: str,
    scale: float,
    counted: Envelope,
    sizes: Mapping[str, float | None],
    held: Callable[[int, int], list[Stretch]],
) -> _Limit:
    """``sizes``: of the limits, before ``scale``, by where they hold in words."""
    reach = scale * _counted_reach(counted)
    known = {where: scale * size for where, size in sizes.items() if size is not None}
    shown = [size for size in known.values() if in_view(size, reach)]
    title = ", ".join(f"{size:.3g}{where}" for where, size in known.items())
    return _Limit(plot, max(shown, default=None), reach, bool(shown), title, scale, held)


def _throughout(size: float) -> Callable[[int, int], list[Stretch]]:
    return lambda begin, end: [(begin, end, size)]
