"""The position errors of one axis over a run, each at the instant of the reading that tells it.

    position error    theta*(t_s) - theta(t_s)      t_s: the reading's own instant, ``sampled_at``
    following error   theta_d(t_s) - theta(t_s)     theta_d: the way between the set-points that were sent

theta* is carried from the cycle's tick to t_s by its rate. It counts for an axis with a position reference,
where a reading came and no step of the reference was less than the settling time ago. A set-point of a drive
in csp or ip is reached one period, 60C2h, after it acts; between two the way is straight. A following error
counts from the second set-point on, lost set-points included.
"""

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NEVER, Duration
from servobench.hil.loop.quantity_by_mode import QUANTITY_BY_MODE
from servobench.hil.loop.scenario import Quantity
from servobench.hil.reviewing.speed_error import ROUNDING, CountedErrors, note_settling
from servobench.hil.rows.recording_plan import AxisPlan
from servobench.hil.rows.records import FATE_SAMPLE, NOTHING, Rows
from servobench.hil.verdict.figures import PositionError

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
        self._following_peak: float | None = None
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
            following_peak_rad=self._following_peak,
        )

    def _take_errors(self, rows: Rows) -> None:
        due_at, reference = rows["due_at"], rows["reference_position_rad"]
        counts = (rows["fate"] == FATE_SAMPLE) & (due_at - self._stepped_at(rows) >= self._settling_ns)
        read = rows[counts]
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
        sent = rows[rows["command_handed_at"] != NOTHING]
        reached_at = np.concatenate((self._reached_at, sent["command_effective_at"] + self._period))
        set_points = np.concatenate((self._set_points, sent["command_position_rad"]))
        read = rows[rows["fate"] == FATE_SAMPLE]
        if reached_at.size > 1:
            read = read[read["sampled_at"] >= reached_at[0]]
            origin = reached_at[0]
            way = np.interp(read["sampled_at"] - origin, reached_at - origin, set_points)
            errors = np.abs(way - read["position_rad"])
            if errors.size:
                self._following_peak = max(self._following_peak or 0.0, float(errors.max()))
        self._reached_at, self._set_points = reached_at[-_KEPT:], set_points[-_KEPT:]
