"""By what the pages of a run that has ended are scaled, and what its signals are held against."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from drivers.rotation import RPM_PER_RAD_S
from drivers.timebase import NS_PER_US
from hil.recording.lanes import error_limit_rpm
from hil.recording.page_series import torque_scale
from hil.recording.plot_scale import about, around_zero
from hil.reviewing.envelope import Envelope, Points
from hil.reviewing.review import Review
from hil.rows.recording_plan import AxisPlan, RecordingPlan

_WORTH_SHOWING: Final = 4.0
"""A limit so many times the signal, or farther, would flatten it: the title names it then."""
COUNTED_SHARE: Final = 0.98
"""Of the error that counts: what a fault of a few cycles does beyond it does not flatten the rest."""
_NEARLY_REACHED: Final = 1.2
"""A limit of the drive that is farther from its signal is said in the title alone."""
_DRAWN: Final = {
    "speed": ("speed/measured", "speed/reference"),
    "torque": ("torque/measured", "torque/command", "torque/load", "torque/brake"),
}
_MARGIN: Final = 1.15
"""Bars end below the frame, with room for the label above the largest."""


def in_view(limit: float, signal: float) -> bool:
    """Whether a limit is shown beside a signal that reaches to ``signal``."""
    return limit <= _WORTH_SHOWING * signal


class _DrawnError(NamedTuple):
    """An error and its limit in the unit of its plot, and the times that do not count."""

    plot: str
    limit: float | None
    reach: float
    settling: Sequence[tuple[int, int]]


class WholeFigures:
    """Of one run."""

    def __init__(
        self,
        plan: RecordingPlan,
        envelopes: Mapping[str, Envelope],
        review: Review,
        marks: Mapping[str, int],
    ) -> None:
        """``envelopes``: by the path of the series. ``marks``: dropouts by axis."""
        self._plan = plan
        self._envelopes = envelopes
        self._marks = marks
        self._axes = plan.review.axes
        self._error_limits = {
            axis.name: error_limit_rpm(meter, plan.review.limits)
            for axis, meter in zip(plan.review.axes, review.errors, strict=True)
        }
        self._speeds = dict(zip((axis.name for axis in self._axes), review.errors, strict=True))
        self._positions = dict(zip((axis.name for axis in self._axes), review.positions, strict=True))

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Of the values, by axis and plot; what is not here is as wide as its data."""
        ranges = {}
        for axis in self._axes:
            for plot, low_high in (
                ("speed", self._data_range(axis.name, *_DRAWN["speed"])),
                ("torque", self._data_range(axis.name, *_DRAWN["torque"])),
                ("delay", self._delay_range(axis.name)),
                ("position", self._data_range(axis.name, "position/measured", "position/reference")),
                *((each.plot, self._error_range(each)) for each in self._errors(axis.name)),
            ):
                if low_high is not None and low_high[0] < low_high[1]:
                    ranges[f"{axis.name}/{plot}"] = low_high
        return ranges

    def remarks(self) -> dict[str, str]:
        """What the titles of plots say of limits that are not in the picture, by axis and plot."""
        remarks = {}
        for axis in self._axes:
            for error in self._errors(axis.name):
                if error.limit is not None:
                    remarks[f"{axis.name}/{error.plot}"] = f" · limit ±{error.limit:.3g}"
            deadline_us = self._plan.deadline / NS_PER_US
            for plot, most in (("torque", self._torque_limit(axis)), ("speed", self._speed_limit(axis))):
                if most is not None:
                    remarks[f"{axis.name}/{plot}"] = f" · limit ±{most:.0f}"
            remarks[f"{axis.name}/delay"] = f" · deadline {deadline_us:.0f}"
            remarks[f"{axis.name}/histogram"] = f", deadline {deadline_us:.0f}"
        return remarks

    def limit_lines(self, begin: int, end: int) -> dict[str, Points]:
        """By the path of the line, instants and values; those that are in the picture."""
        lines: dict[str, Points] = {}
        ends = np.array([begin, end])
        for axis in self._axes:
            name = axis.name
            if in_view(self._plan.deadline / NS_PER_US, self._reach(name, "delay/delay")):
                lines[f"/{name}/delay/deadline"] = ends, np.full(2, self._plan.deadline / NS_PER_US)
            for plot, limit, reach, windows in self._errors(name):
                if limit is not None and in_view(limit, reach):
                    times, scale = _outside(windows, begin, end)
                    lines[f"/{name}/{plot}/most"] = times, limit * scale
                    lines[f"/{name}/{plot}/least"] = times, -limit * scale
            for plot, most in (("torque", self._torque_limit(axis)), ("speed", self._speed_limit(axis))):
                if most is not None and most <= _NEARLY_REACHED * self._reach(name, *_DRAWN[plot]):
                    lines[f"/{name}/{plot}/most"] = ends, np.full(2, most)
                    lines[f"/{name}/{plot}/least"] = ends, np.full(2, -most)
        return lines

    def _reach(self, name: str, *paths: str) -> float:
        """The largest by size."""
        return max((abs(value) for value in self._ends(name, *paths)), default=0.0)

    def _ends(self, name: str, *paths: str) -> Iterator[float]:
        for path in paths:
            envelope = self._envelopes.get(f"/{name}/{path}")
            if envelope is not None and (ends := envelope.ends()) is not None:
                yield from ends

    def _data_range(self, name: str, *paths: str) -> tuple[float, float] | None:
        return about(self._ends(name, *paths))

    def _errors(self, name: str) -> tuple[_DrawnError, ...]:
        """Of the speed and of the position."""
        speed, position = self._speeds[name], self._positions[name]
        speed_reach = _counted_reach(speed.counted) * RPM_PER_RAD_S
        position_limit = self._plan.review.limits.position_error_peak_rad_max
        return (
            _DrawnError("error", self._error_limits[name], speed_reach, speed.settling),
            _DrawnError(
                "position_error", position_limit, _counted_reach(position.counted), position.settling
            ),
        )

    @staticmethod
    def _error_range(error: _DrawnError) -> tuple[float, float] | None:
        """As wide as the error that counts, not as a step's first instant; with a limit that is near."""
        reach = error.reach
        if error.limit is not None and in_view(error.limit, reach):
            reach = max(reach, error.limit)
        return around_zero(reach) if reach else None

    def _torque_limit(self, axis: AxisPlan) -> float | None:
        return None if axis.torque_max_nm is None else axis.torque_max_nm * torque_scale(axis)[0]

    def _speed_limit(self, axis: AxisPlan) -> float | None:
        return None if axis.speed_max_rad_s is None else axis.speed_max_rad_s * RPM_PER_RAD_S

    def _delay_range(self, name: str) -> tuple[float, float] | None:
        """From 0, or from where a drive's clock was wrong, with the deadline, if that is near."""
        values = list(self._ends(name, "delay/delay"))
        if not values:
            return None
        deadline_us, top = self._plan.deadline / NS_PER_US, max(values)
        if in_view(deadline_us, top):
            top = max(top, deadline_us)
        least = min(values)
        return min(-0.08 * top, _MARGIN * least), _MARGIN * top


def _counted_reach(counted: Envelope) -> float:
    """The peak of an error that counts, but no more than some times what nearly all of it keeps."""
    peak, most = counted.largest(), counted.largest(COUNTED_SHARE)
    return 0.0 if peak is None or most is None else min(peak, _WORTH_SHOWING * most or peak)


def _outside(settling: Sequence[tuple[int, int]], begin: int, end: int) -> Points:
    """Ends of the stretches in which an error counts, and 1 there; no number in between."""
    times, scale = [begin], [1.0]
    for start, stop in settling:
        times += [start, start + 1, min(stop, end)]
        scale += [1.0, np.nan, 1.0]
    return np.array([*times, end]), np.array([*scale, 1.0])
