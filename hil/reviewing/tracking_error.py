"""The speed and position errors of one axis over a run, and which cycles count for them.

The speed error of a cycle is its reference minus the speed that the drive measured at that
cycle's SYNC. It counts if a reading came (a dropout says nothing about the motor) and
the axis had time to settle:

    reference  ____/~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
    load       _______________________/~~~~~~~~~~~~
    counts     ----|  settling  |-----------------    peak, rms
    after load                        |-----------    peak in percent of the reference

A reference step is a change between two cycles that the axis cannot follow: faster than
its torque limit and inertia allow. A ramp or a sine within that opens no window.
After a change of load the error is also taken in percent of the reference, until the
reference changes.

Position errors hold at the instant of the reading that tells them:

    position error    theta*(t_s) - theta(t_s)      t_s: the reading's own instant, ``sampled_at``
    following error   theta_d(t_s) - theta(t_s)     theta_d: the way between the set-points that were sent

theta* is carried from the cycle's tick to t_s by its rate. It counts for an axis with a position reference,
where a reading came and no step of the reference was less than the settling time ago. A set-point of a drive
in csp or ip is reached one period, 60C2h, after it acts; between two the way is straight. A following error
counts from the second set-point on, lost set-points included.

Where the limits of an error hold in a run, and the lines that show them.

    speed_error_peak_percent_max  ----|  settling  |------------------------
    after_load_percent_max                               ---------   after a change of load
    drawn: the tighter            ----              -----_________---

No limit holds while a speed settles after a step of its reference.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NEVER, NS_PER_S, Duration
from servobench.hil.loop.cycle_record import FATE_SAMPLE, NOTHING
from servobench.hil.loop.scenario import QUANTITY_BY_MODE, Quantity
from servobench.hil.reviewing.envelope import Envelope, Largest, Points, largest
from servobench.hil.rows.recording_plan import AxisPlan
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.figures import PositionError, SpeedError, StepResponse
from servobench.hil.verdict.metrics import VerdictLimits

ROUNDING = 1.0 + 1e-9
"""A ramp at the very limit is no step: in double precision it misses it by 1e-16 of the speeds it is the
difference of."""
_LOADED_MAX = 1_000
"""More stretches after a change of load cannot be told apart in a picture."""
AnyFigures = TypeVar("AnyFigures", SpeedError, PositionError, StepResponse)


class AskedChanges:
    """By how much reference and load of one axis change from row to row, from one call to the next."""

    def __init__(self, acceleration_max_rad_s2: float) -> None:
        self._acceleration_max = acceleration_max_rad_s2
        self._last: tuple[float, float, int] | None = None

    def take(self, rows: Rows) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """(n,) each: changes of the reference and of the load, and where the reference steps.

        ``rows``: (n,), at least one.
        """
        reference, load, due_at = rows["reference_rad_s"], rows["load_torque_nm"], rows["due_at"]
        if self._last is None:  # the axis starts at rest; its first load is no change
            self._last = 0.0, float(load[0]), int(due_at[0])
        change = np.diff(reference, prepend=self._last[0])
        load_change = np.diff(load, prepend=self._last[1])
        elapsed_s = np.diff(due_at, prepend=self._last[2]) / NS_PER_S
        self._last = float(reference[-1]), float(load[-1]), int(due_at[-1])
        return change, load_change, np.abs(change) > self._acceleration_max * elapsed_s * ROUNDING


class PeakEnvelope(Envelope):
    """With the largest value and when its cycle was due, ns."""

    def __init__(self) -> None:
        super().__init__()
        self.peak = Largest()

    def add(self, times: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Take in the instants, (n,) ns, at which the cycles were due, and the values, (n,)."""
        super().add(times, values)
        self.peak.look(times, values)


class CountedErrors(PeakEnvelope):
    """The errors that count, by size."""

    def __init__(self) -> None:
        super().__init__()
        self._count, self._square_sum = 0, 0.0

    def add(self, times: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Add values, as to an envelope."""
        if not values.size:
            return
        super().add(times, values)
        self._count += values.size
        # cumsum adds from left to right; sum() adds in pairs, whose result depends on the chunk
        self._square_sum = float(np.cumsum(np.concatenate(([self._square_sum], values * values)))[-1])

    @property
    def rms(self) -> float | None:
        """None: there is no error."""
        return math.sqrt(self._square_sum / self._count) if self._count else None


class SpeedErrorMeter:
    """Streaming; any division of the rows into chunks gives the same figures, bit by bit."""

    def __init__(self, axis: AxisPlan, settling_ns: int) -> None:
        self._settling_ns = settling_ns
        self._asked = AskedChanges(axis.acceleration_max_rad_s2)
        self._rows = 0
        self._step_at = -NEVER
        self._reference_changed_row = self._load_changed_row = -1
        self.reference_peak = 0.0
        """Largest reference by size, rad/s; the base of the peak in percent."""
        self.settling: list[tuple[int, int]] = []
        """From when to when the error is not counted, ns; in order, and apart from each other."""
        self.counted = CountedErrors()
        """rad/s."""
        self.after_load = PeakEnvelope()
        """Errors after a change of load, as a share of the reference."""
        self.loaded: list[tuple[int, int, float]] = []
        """Stretches after a change of load under an unchanged reference: begin and end, ns, and the size of
        the reference, rad/s; the first thousand."""
        self._is_loaded = self._notes_loaded = False

    def add(self, rows: Rows) -> None:
        """Take in rows of this axis: (n,) of ROW_DTYPE, in order of sequence."""
        if not rows.size:
            return
        reference = rows["reference_rad_s"]
        error = np.abs(reference - rows["velocity_rad_s"])
        counts, after_load = self._windows(rows)
        self._note_loaded(rows["due_at"], np.abs(reference), after_load)
        self.reference_peak = max(self.reference_peak, float(np.abs(reference).max()))
        self.counted.add(rows["due_at"][counts], error[counts])
        relative = counts & after_load & (reference != 0.0)
        self.after_load.add(rows["due_at"][relative], error[relative] / np.abs(reference[relative]))

    def figures(self) -> SpeedError:
        """Return the figures of all rows so far."""
        peak, share = self.counted.peak.value, self.after_load.peak.value
        return SpeedError(
            peak_rad_s=peak,
            peak_percent=100.0 * peak / self.reference_peak
            if peak is not None and self.reference_peak
            else None,
            rms_rad_s=self.counted.rms,
            after_load_percent=None if share is None else 100.0 * share,
        )

    def _note_loaded(
        self, due_at: NDArray[np.int64], reference: NDArray[np.float64], after_load: NDArray[np.bool_]
    ) -> None:
        for row in np.flatnonzero(after_load != np.append(self._is_loaded, after_load[:-1])):
            at = int(due_at[row])
            if not after_load[row]:
                self._reach_loaded(at)
            self._notes_loaded = bool(after_load[row]) and len(self.loaded) < _LOADED_MAX
            if self._notes_loaded:
                self.loaded.append((at, at, float(reference[row])))
        self._is_loaded = bool(after_load[-1])
        self._reach_loaded(int(due_at[-1]))

    def _reach_loaded(self, at: int) -> None:
        if self._notes_loaded:
            begin, _, reference = self.loaded[-1]
            self.loaded[-1] = begin, at, reference

    def _windows(self, rows: Rows) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which rows count, and which lie after a change of load under an unchanged reference."""
        due_at = rows["due_at"]
        reference_change, load_change, stepped = self._asked.take(rows)
        note_settling(self.settling, due_at[stepped], self._settling_ns)
        step_at = np.maximum.accumulate(np.where(stepped, due_at, self._step_at))
        numbers = np.arange(self._rows, self._rows + rows.size)
        reference_row = _last_marked(reference_change != 0.0, numbers, self._reference_changed_row)
        load_row = _last_marked(load_change != 0.0, numbers, self._load_changed_row)
        self._rows += rows.size
        self._step_at = int(step_at[-1])
        self._reference_changed_row, self._load_changed_row = int(reference_row[-1]), int(load_row[-1])
        counts = (rows["fate"] == FATE_SAMPLE) & (due_at - step_at >= self._settling_ns)
        return counts, load_row > reference_row


def note_settling(windows: list[tuple[int, int]], stepped_at: NDArray[np.int64], settling_ns: int) -> None:
    """Add to ``windows`` those that steps open, ns; one that is open yet goes on."""
    for at in stepped_at.tolist():
        if windows and at <= windows[-1][1]:
            windows[-1] = windows[-1][0], at + settling_ns
        else:
            windows.append((at, at + settling_ns))


def _last_marked(marks: NDArray[np.bool_], numbers: NDArray[np.int64], before: int) -> NDArray[np.int64]:
    """For each row the number of the last marked row up to it; ``before`` if there is none."""
    return np.maximum.accumulate(np.where(marks, numbers, before))


def worst(kind: type[AnyFigures], figures: Sequence[AnyFigures]) -> AnyFigures:
    """The largest of each figure of a ``kind`` over the axes; None: it was measured on none."""
    names = [each.name for each in fields(kind)]
    return kind(**{name: largest(getattr(one, name) for one in figures) for name in names})


_RESOLUTION_RAD = 1e-6
"""A sixth of a count of 2^20 a turn: rounding is no step."""
_KEPT = 8
"""Set-points of before, between which the readings of the next rows lie: those of a few periods."""


class PositionErrorMeter:
    """Streaming; any division of the rows into chunks gives the same figures, bit by bit."""

    def __init__(self, axis: AxisPlan, settling_ns: int, period: Duration) -> None:
        self._acceleration_max = axis.acceleration_max_rad_s2
        self._settling_ns = settling_ns
        self._period = period
        self._asked = axis.quantity == "position"
        self._follows = QUANTITY_BY_MODE.get(axis.mode) is Quantity.POSITION
        self._last: tuple[float, float, int] | None = None
        self._step_at = -NEVER
        self._reached_at = np.empty(0, np.int64)
        self._set_points = np.empty(0)
        self.following = PeakEnvelope()
        """rad, by the cycle whose reading tells them."""
        self.counted = CountedErrors()
        """rad."""
        self.settling: list[tuple[int, int]] = []
        """From when to when none counts, ns."""

    def add(self, rows: Rows) -> None:
        """Take in rows of this axis: (n,) of ROW_DTYPE, in order of sequence."""
        if rows.size and self._asked:
            self._take_errors(rows)
        if rows.size and self._follows:
            self._take_following(rows)

    def figures(self) -> PositionError:
        """Return the figures of all rows so far."""
        return PositionError(
            peak_rad=self.counted.peak.value,
            rms_rad=self.counted.rms,
            following_peak_rad=self.following.peak.value,
        )

    def _take_errors(self, rows: Rows) -> None:
        due_at, reference = rows["due_at"], rows["reference_position_rad"]
        counts = (rows["fate"] == FATE_SAMPLE) & (due_at - self._stepped_at(rows) >= self._settling_ns)
        read = rows.compress(counts)
        passed_s = (read["sampled_at"] - read["due_at"]) / 1e9
        asked = reference[counts] + read["reference_rad_s"] * passed_s
        self.counted.add(read["due_at"], np.abs(asked - read["position_rad"]))

    def _stepped_at(self, rows: Rows) -> NDArray[np.int64]:
        """For each row when the last step of the reference was: of position or of speed, by more than the
        motor's acceleration makes from one cycle to the next."""
        due_at, reference, rate = rows["due_at"], rows["reference_position_rad"], rows["reference_rad_s"]
        if self._last is None:
            self._last = (float(reference[0]), float(rate[0]), int(due_at[0]))
        elapsed_s = np.diff(due_at, prepend=self._last[2]) / 1e9
        before = np.concatenate(([self._last[1]], rate[:-1]))
        jump = np.abs(np.diff(reference, prepend=self._last[0]) - before * elapsed_s)
        bound = self._acceleration_max * elapsed_s * ROUNDING
        beyond = (jump > bound * elapsed_s + _RESOLUTION_RAD) | (np.abs(rate - before) > bound)
        note_settling(self.settling, due_at[beyond], self._settling_ns)
        stepped = np.maximum.accumulate(np.where(beyond, due_at, self._step_at))
        self._last = (float(reference[-1]), float(rate[-1]), int(due_at[-1]))
        self._step_at = int(stepped[-1])
        return stepped

    def _take_following(self, rows: Rows) -> None:
        sent = rows.compress(rows["command_handed_at"] != NOTHING)
        reached_at = np.concatenate((self._reached_at, sent["command_effective_at"] + self._period))
        set_points = np.concatenate((self._set_points, sent["command_position_rad"]))
        read = rows.compress(rows["fate"] == FATE_SAMPLE)
        if reached_at.size > 1:
            read = read.compress(read["sampled_at"] >= reached_at[0])
            origin = reached_at[0]
            way = np.interp(read["sampled_at"] - origin, reached_at - origin, set_points)
            self.following.add(read["due_at"], np.abs(way - read["position_rad"]))
        self._reached_at, self._set_points = reached_at[-_KEPT:], set_points[-_KEPT:]


Stretch = tuple[int, int, float]
"""Begin and end, ns, and how large an error may be there."""


def speed_limits(meter: SpeedErrorMeter, limits: VerdictLimits) -> dict[str, float | None]:
    """Return the limits of the speed error, rad/s, by where they hold in words; after a load the largest."""
    peak, after = limits.speed_error_peak_percent_max, limits.after_load_percent_max
    largest = max((size for _, _, size in meter.loaded), default=0.0)
    return {
        "": None if peak is None else peak / 100.0 * meter.reference_peak,
        " after load": None if after is None or not largest else after / 100.0 * largest,
    }


def speed_stretches(meter: SpeedErrorMeter, limits: VerdictLimits, begin: int, end: int) -> list[Stretch]:
    """Return the stretches between ``begin`` and ``end`` in which the speed error is judged; rad/s, the
    tighter of two limits."""
    most, after = speed_limits(meter, limits)[""], limits.after_load_percent_max
    loaded: list[Stretch] = []
    if after is not None:
        loaded = [(a, b, after / 100.0 * size) for a, b, size in meter.loaded if size]
        if most is not None:
            loaded = [each for each in loaded if each[2] < most]
    held = loaded
    if most is not None:
        held = sorted([*loaded, *without([(begin, end, most)], [(a, b) for a, b, _ in loaded])])
    return list(without(held, meter.settling))


def position_stretches(
    meter: PositionErrorMeter, limits: VerdictLimits, begin: int, end: int
) -> list[Stretch]:
    """Return the stretches in which the position error is judged; rad."""
    most = limits.position_error_peak_rad_max
    return [] if most is None else list(without([(begin, end, most)], meter.settling))


def without(stretches: Sequence[Stretch], windows: Sequence[tuple[int, int]]) -> Iterator[Stretch]:
    """Yield what ``windows`` leave of ``stretches``, both in order of time and apart from each other."""
    place = 0
    for begin, end, size in stretches:
        while place < len(windows) and windows[place][1] <= begin:
            place += 1
        at, window = begin, place
        while window < len(windows) and windows[window][0] < end:
            if windows[window][0] > at:
                yield at, windows[window][0], size
            at = windows[window][1]
            window += 1
        if at < end:
            yield at, end, size


def limit_points(stretches: Sequence[Stretch], scale: float = 1.0) -> Points:
    """Return a line over ``stretches``; between two there is no number."""
    times, values = list[int](), list[float]()
    for begin, end, size in stretches:
        if times:
            times.append(min(times[-1] + 1, begin))
            values.append(np.nan)
        times += [begin, end]
        values += [scale * size] * 2
    return np.array(times, np.int64), np.array(values, np.float64)
