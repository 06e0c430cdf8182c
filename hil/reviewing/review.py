"""The figures of a run, computed from its packed records in bounded memory, chunk by chunk."""

import hashlib

import numpy as np

from drivers.timebase import NS_PER_US, Instant
from hil.reviewing.certificate_meter import CertificateMeter
from hil.reviewing.histogram import TimeHistogram
from hil.reviewing.speed_error import SpeedErrorMeter, largest, worst
from hil.reviewing.torque_swing import TorqueSwingMeter
from hil.rows.recording_plan import ReviewPlan
from hil.rows.records import CAUSES, DIGESTED_BYTES, NOTHING, ROW_DTYPE, Rows
from hil.rows.side_rows import TextEvent
from hil.verdict.summary import DropoutCounts, Figures, Percentiles

DIGEST_BYTES = 16


class Review:
    """Feed it rows in the order of recording; ask for the figures at any time.

    The digest covers the fields of every row before ``compute_ns``. In simulated time each of them follows
    from the bench file and the seed; in real time the digest only names the recording.
    """

    def __init__(self, plan: ReviewPlan) -> None:
        self.delay = TimeHistogram()
        self._lateness = TimeHistogram()
        self._compute = TimeHistogram()
        self._axes = plan.axes
        self._errors = [SpeedErrorMeter(axis, plan.settling) for axis in plan.axes]
        self._swings = [TorqueSwingMeter(axis, plan.settling) for axis in plan.axes]
        self._certificates = {
            number: CertificateMeter(axis.certified, plan.settling)
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
        packed = np.ascontiguousarray(rows).view(np.uint8).reshape(rows.size, ROW_DTYPE.itemsize)
        self._digest.update(np.ascontiguousarray(packed[:, :DIGESTED_BYTES]).data)
        self._fates += np.bincount(rows["fate"], minlength=self._fates.size)
        delay = rows["delay_ns"]
        self.delay.add(delay[delay != NOTHING])
        woken = rows[rows["woke_at"] != NOTHING]
        self._lateness.add(woken["woke_at"] - woken["due_at"])
        compute = rows["compute_ns"]
        self._compute.add(compute[compute != NOTHING])
        for axis, meter in enumerate(self._errors):
            mine = rows if len(self._errors) == 1 else rows[rows["axis"] == axis]
            self._count(axis, mine)
            meter.add(mine)
            self._swings[axis].add(mine)
            if axis in self._certificates:
                self._certificates[axis].add(mine)

    def _count(self, axis: int, rows: Rows) -> None:
        first = self._axis_rows[axis] + 1
        if self._dense[axis] == first - 1:
            wrong = np.flatnonzero(rows["sequence"] != np.arange(first, first + rows.size))
            self._dense[axis] += int(wrong[0]) if wrong.size else rows.size
        self._axis_rows[axis] += rows.size

    def take_events(self) -> list[TextEvent]:
        """What the rows since the last call tell that is worth reading."""
        found = [
            (swing.at, axis.name, swing.describe())
            for axis, meter in zip(self._axes, self._swings, strict=True)
            for swing in meter.take_swings()
        ]
        for number, certificate in self._certificates.items():
            if (exceeded := certificate.take_exceeded()) is not None:
                found.append((exceeded[0], self._axes[number].name, exceeded[1]))
        return [TextEvent(Instant(at), "WARN", f"{axis}: {text}") for at, axis, text in sorted(found)]

    def figures(self) -> Figures:
        """The figures of all rows so far."""
        count = {cause: int(self._fates[place]) for place, cause in enumerate(CAUSES, start=1)}
        return Figures(
            cycles=max(self._axis_rows, default=0),
            rows=int(self._fates.sum()),
            dense=min(self._dense, default=0),
            dropouts=DropoutCounts(**{cause.value: number for cause, number in count.items()}),
            delay_us=_percentiles_us(self.delay),
            speed_error=worst([meter.figures() for meter in self._errors]),
            lateness_us=_percentiles_us(self._lateness),
            compute_us=_percentiles_us(self._compute),
            digest=self._digest.hexdigest(),
            torque_rms_nm=largest(meter.rms_nm for meter in self._swings),
            certificates={
                self._axes[number].name: meter.figures() for number, meter in self._certificates.items()
            },
        )


def _percentiles_us(times: TimeHistogram) -> Percentiles:
    p50, p99, largest = times.quantile_ns(0.50), times.quantile_ns(0.99), times.largest_ns
    if p50 is None or p99 is None or largest is None:
        return Percentiles(None, None, None)
    return Percentiles(p50 / NS_PER_US, p99 / NS_PER_US, largest / NS_PER_US)
