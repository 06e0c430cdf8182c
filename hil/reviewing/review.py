"""The figures of a run, computed from its packed records in bounded memory, chunk by chunk."""

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.timebase import NS_PER_US, Instant
from hil.reviewing.certificate_meter import CertificateMeter
from hil.reviewing.histogram import TimeHistogram, merged
from hil.reviewing.position_error import PositionErrorMeter
from hil.reviewing.speed_error import SpeedErrorMeter, largest, worst
from hil.reviewing.step_response import LossRun, StepMeter, worst_steps
from hil.reviewing.torque_swing import TorqueSwingMeter
from hil.rows.recording_plan import ReviewPlan
from hil.rows.records import CAUSES, DIGESTED_BYTES, NOTHING, ROW_DTYPE, Rows
from hil.rows.side_rows import TextEvent
from hil.verdict.summary import DropoutCounts, Figures, Percentiles, PositionError, SpeedError
from hil.verdict.verdict import WorstPlace

DIGEST_BYTES = 16
"""128 bits: of 2^64 runs two are alike by chance."""


class LargestTime:
    """The largest of what was shown, and where it was."""

    def __init__(self) -> None:
        self._value = 0.0
        self._at: int | None = None

    def look(self, due_at: NDArray[np.int64], values: NDArray[np.int64]) -> None:
        """``values``: (n,) of the cycles that were due at ``due_at``."""
        if values.size and (self._at is None or values.max() > self._value):
            place = int(values.argmax())
            self._value, self._at = float(values[place]), int(due_at[place])

    def place(self, zero: int) -> WorstPlace | None:
        """None: nothing was shown."""
        return None if self._at is None else WorstPlace("", self._at - zero)


class Review:
    """Feed it rows in the order of recording; ask for the figures at any time.

    The digest covers the fields of every row before ``compute_ns``. In simulated time each of them follows
    from the bench file and the seed; in real time the digest only names the recording.
    """

    def __init__(self, plan: ReviewPlan) -> None:
        self.delays = [TimeHistogram() for _ in plan.axes]
        """Of the readings of each axis."""
        self._lateness = TimeHistogram()
        self._compute = TimeHistogram()
        self._latest, self._longest = LargestTime(), LargestTime()
        self._zero = 0
        self._axes = plan.axes
        self.errors = [SpeedErrorMeter(axis, plan.settling) for axis in plan.axes]
        self._steps = [StepMeter(axis, plan.band_percent) for axis in plan.axes]
        self._runs = [LossRun() for _ in plan.axes]
        self._swings = [TorqueSwingMeter(axis, plan.settling) for axis in plan.axes]
        self.positions = [PositionErrorMeter(axis, plan.settling, plan.period) for axis in plan.axes]
        self._certificates = {
            number: CertificateMeter(axis, plan.settling)
            for number, axis in enumerate(plan.axes)
            if axis.certified is not None
        }
        self._axis_rows = [0] * len(plan.axes)
        self._dense = [0] * len(plan.axes)
        """Of each axis, the cycles up to the first that is missing or double."""
        self._fates = np.zeros(len(CAUSES) + 1, np.int64)
        self._digest = hashlib.blake2b(digest_size=DIGEST_BYTES)

    def add(self, rows: Rows) -> None:
        """Take in ``rows``: (n,) of ROW_DTYPE, each axis in order of sequence.

        Any division into chunks gives the same figures.
        """
        if rows.dtype != ROW_DTYPE:
            raise TypeError(f"rows of {rows.dtype}, expected ROW_DTYPE")
        if not rows.size:
            return
        if not any(self._axis_rows):
            self._zero = int(rows["due_at"][0])
        packed = np.ascontiguousarray(rows).view(np.uint8).reshape(rows.size, ROW_DTYPE.itemsize)
        self._digest.update(np.ascontiguousarray(packed[:, :DIGESTED_BYTES]).data)
        self._fates += np.bincount(rows["fate"], minlength=self._fates.size)
        self._add_host_times(rows)
        for axis, meter in enumerate(self.errors):
            mine = rows if len(self.errors) == 1 else rows[rows["axis"] == axis]
            self._count(axis, mine)
            delay = mine["delay_ns"]
            self.delays[axis].add(delay[delay != NOTHING])
            if self._axes[axis].quantity == "speed":
                meter.add(mine)
                self._steps[axis].add(mine)
            self._runs[axis].add(mine)
            if self._axes[axis].mode == "cst":
                self._swings[axis].add(mine)
            self.positions[axis].add(mine)
            if axis in self._certificates:
                self._certificates[axis].add(mine)

    def _add_host_times(self, rows: Rows) -> None:
        due_at, woke_at, compute = rows["due_at"], rows["woke_at"], rows["compute_ns"]
        woken = woke_at != NOTHING
        lateness = woke_at[woken] - due_at[woken]
        self._lateness.add(lateness)
        self._latest.look(due_at[woken], lateness)
        computed = compute != NOTHING
        self._compute.add(compute[computed])
        self._longest.look(due_at[computed], compute[computed])

    def _count(self, axis: int, rows: Rows) -> None:
        first = self._axis_rows[axis] + 1
        if self._dense[axis] == first - 1:
            wrong = np.flatnonzero(rows["sequence"] != np.arange(first, first + rows.size))
            self._dense[axis] += int(wrong[0]) if wrong.size else rows.size
        self._axis_rows[axis] += rows.size

    def take_events(self) -> list[TextEvent]:
        """What the rows since the last call tell that is worth reading."""
        events = [
            (swing.at, axis.name, swing.describe())
            for axis, meter in zip(self._axes, self._swings, strict=True)
            for swing in meter.take_swings()
        ]
        for number, certificate in self._certificates.items():
            if (exceeded := certificate.take_exceeded()) is not None:
                events.append((exceeded[0], self._axes[number].name, exceeded[1]))
        return [TextEvent(Instant(at), "WARN", f"{axis}: {text}") for at, axis, text in sorted(events)]

    def figures(self) -> Figures:
        """The figures of all rows so far."""
        count = {cause: int(self._fates[place]) for place, cause in enumerate(CAUSES, start=1)}
        return Figures(
            cycles=max(self._axis_rows, default=0),
            rows=int(self._fates.sum()),
            dense=min(self._dense, default=0),
            dropouts=DropoutCounts(**{cause.value: number for cause, number in count.items()}),
            delay_us=_percentiles_us(merged(self.delays)),
            speed_error=worst(SpeedError, [meter.figures() for meter in self.errors]),
            lateness_us=_percentiles_us(self._lateness),
            compute_us=_percentiles_us(self._compute),
            digest=self._digest.hexdigest(),
            position_error=worst(PositionError, [meter.figures() for meter in self.positions]),
            torque_rms_nm=largest(meter.rms_nm for meter in self._swings),
            step_response=worst_steps(self._steps),
            losses_in_a_row=max((run.most for run in self._runs), default=0),
            certificates={
                self._axes[number].name: meter.figures() for number, meter in self._certificates.items()
            },
            worst=self._worst(),
        )

    def _worst(self) -> dict[str, WorstPlace]:
        """Where the values of the limits come from, by the limits' names; those that have one place."""
        errors = [meter.figures() for meter in self.errors]
        steps = [meter.figures() for meter in self._steps]
        settling, over, recovery = ([meter.instants[place] for meter in self._steps] for place in range(3))
        places = {
            "settling_time_ms_max": self._worst_axis([each.settling_time_ms for each in steps], settling),
            "overshoot_percent_max": self._worst_axis([each.overshoot_percent for each in steps], over),
            "recovery_time_ms_max": self._worst_axis([each.recovery_time_ms for each in steps], recovery),
            "losses_in_a_row_max": self._worst_axis(
                [run.most or None for run in self._runs], [run.at for run in self._runs]
            ),
            "speed_error_peak_percent_max": self._worst_axis(
                [each.peak_percent for each in errors], [meter.counted.peak_at for meter in self.errors]
            ),
            "after_load_percent_max": self._worst_axis(
                [each.after_load_percent for each in errors], [meter.after_load_at for meter in self.errors]
            ),
            "speed_error_rms_rad_s_max": self._worst_axis([each.rms_rad_s for each in errors]),
            "delay_p99_us_max": self._worst_axis([times.quantile_ns(0.99) for times in self.delays]),
            "torque_rms_nm_max": self._worst_axis(
                [meter.rms_nm for meter in self._swings], [meter.worst_at for meter in self._swings]
            ),
            "lateness_us_max": self._latest.place(self._zero),
            "compute_us_max": self._longest.place(self._zero),
        }
        return {name: place for name, place in places.items() if place is not None}

    def _worst_axis(
        self, values: Sequence[float | None], instants: Sequence[int | None] | None = None
    ) -> WorstPlace | None:
        """The axis with the largest value, and when that was, if it was at one instant."""
        known = [(value, axis) for axis, value in enumerate(values) if value is not None]
        if not known:
            return None
        _, axis = max(known, key=lambda each: each[0])
        at = instants[axis] if instants is not None else None
        return WorstPlace(self._axes[axis].name, None if at is None else at - self._zero)


def _percentiles_us(times: TimeHistogram) -> Percentiles:
    p50, p99, largest = times.quantile_ns(0.50), times.quantile_ns(0.99), times.largest_ns
    if p50 is None or p99 is None or largest is None:
        return Percentiles(None, None, None)
    return Percentiles(p50 / NS_PER_US, p99 / NS_PER_US, largest / NS_PER_US)
