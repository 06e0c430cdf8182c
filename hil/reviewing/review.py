"""The figures of a run, computed from its packed records in bounded memory, chunk by chunk."""

import hashlib
from collections.abc import Iterator

import numpy as np

from servobench.drivers.timebase import NS_PER_US, Instant
from servobench.hil.loop.cycle_record import CAUSES, NAMES, NOTHING
from servobench.hil.reviewing.certificate_meter import CertificateMeter
from servobench.hil.reviewing.envelope import Largest, largest
from servobench.hil.reviewing.histogram import TimeHistogram, merged
from servobench.hil.reviewing.network_meter import AxisNetworkMeter, NetworkMeter
from servobench.hil.reviewing.step_response import StepMeter, worst_steps
from servobench.hil.reviewing.torque_swing import TorqueSwingMeter
from servobench.hil.reviewing.tracking_error import PositionErrorMeter, SpeedErrorMeter, worst
from servobench.hil.rows.recording_plan import AxisPlan, ReviewPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.side_rows import TextEvent
from servobench.hil.verdict.figures import (
    DropoutCounts,
    Figures,
    Percentiles,
    PositionError,
    SpeedError,
    WorstPlace,
)

DIGEST_BYTES = 16
"""128 bits: of 2^64 runs two are alike by chance."""


class _AxisMeters:
    """Meters of one axis."""

    def __init__(self, axis: AxisPlan, plan: ReviewPlan, network: AxisNetworkMeter) -> None:
        self.axis = axis
        self.network = network
        self.error = SpeedErrorMeter(axis, plan.settling)
        self.steps = StepMeter(axis, plan.band_percent)
        self.swing = TorqueSwingMeter(axis, plan.settling)
        self.position = PositionErrorMeter(axis, plan.settling, plan.period)
        self.certificate = None if axis.certified is None else CertificateMeter(axis, plan.settling, network)
        self.rows = 0
        self.dense = 0
        """Cycles up to the first that is missing or double."""

    def add(self, rows: Rows) -> None:
        """Take in rows of the axis."""
        if self.dense == self.rows:
            wrong = np.flatnonzero(rows["sequence"] != np.arange(self.rows + 1, self.rows + 1 + rows.size))
            self.dense += int(wrong[0]) if wrong.size else rows.size
        self.rows += rows.size
        if self.axis.quantity == "speed":
            self.error.add(rows)
            self.steps.add(rows)
        if self.axis.mode == "cst":
            self.swing.add(rows)
        self.position.add(rows)
        if self.certificate is not None:
            self.certificate.add(rows)

    def events(self) -> Iterator[tuple[int, str]]:
        """Yield the notable events in the rows since the last call."""
        for swing in self.swing.take_swings():
            yield swing.at, swing.describe()
        if self.certificate is not None and (exceeded := self.certificate.take_exceeded()) is not None:
            yield exceeded

    def places(self) -> dict[str, tuple[float | None, int | None]]:
        """By the limits' names: values that may be the worst of all axes, and when they were, if they were
        at one instant."""
        error, steps = self.error.figures(), self.steps.figures()
        settling_at, over_at, recovery_at = self.steps.instants
        lost = self.network.readings_lost
        return {
            "settling_time_ms_max": (steps.settling_time_ms, settling_at),
            "overshoot_percent_max": (steps.overshoot_percent, over_at),
            "recovery_time_ms_max": (steps.recovery_time_ms, recovery_at),
            "losses_in_a_row_max": (lost.most or None, lost.at),
            "speed_error_peak_percent_max": (error.peak_percent, self.error.counted.peak.at),
            "after_load_percent_max": (error.after_load_percent, self.error.after_load.peak.at),
            "speed_error_rms_rad_s_max": (error.rms_rad_s, None),
            "delay_p99_us_max": (self.network.reading.quantile_ns(0.99), None),
            "torque_rms_nm_max": (self.swing.worst.value, self.swing.worst.at),
        }


class Review:
    """Feed it rows in the order of recording; ask for the figures at any time.

    The digest covers every column that a run is judged by (:data:`servobench.hil.rows.records.DIGESTED`). In
    simulated time each of them follows from the bench file and the seed; in real time the digest names the
    recording.
    """

    def __init__(self, plan: ReviewPlan) -> None:
        self.network = NetworkMeter(plan.period // NS_PER_US, len(plan.axes))
        self._axes = [
            _AxisMeters(axis, plan, network)
            for axis, network in zip(plan.axes, self.network.axes, strict=True)
        ]
        self.delays = [network.reading for network in self.network.axes]
        """Delays of the readings of each axis."""
        self.errors = [axis.error for axis in self._axes]
        self.positions = [axis.position for axis in self._axes]
        self._lateness, self._compute = TimeHistogram(), TimeHistogram()
        self._latest, self._longest = Largest(), Largest()
        self._zero: int | None = None
        """The first cycle."""
        self._fates = np.zeros(len(CAUSES) + 1, np.int64)
        self._digest, self._digested = hashlib.blake2b(digest_size=DIGEST_BYTES), plan.digested

    def add(self, rows: Rows) -> None:
        """Take in ``rows``: (n,) of ROW_DTYPE, each axis in order of sequence.

        Any division into chunks gives the same figures.
        """
        if rows.dtype != ROW_DTYPE:
            raise TypeError(f"rows of {rows.dtype}, expected ROW_DTYPE")
        if not rows.size:
            return
        if self._zero is None:
            self._zero = int(rows["due_at"][0])
        packed = np.ascontiguousarray(rows).view("<u8").reshape(rows.size, len(NAMES))
        self._digest.update(np.ascontiguousarray(packed[:, self._digested]).data)
        self._fates += np.bincount(rows["fate"], minlength=self._fates.size)
        self._add_host_times(rows)
        self.network.add(rows)
        for number, axis in enumerate(self._axes):
            axis.add(rows if len(self._axes) == 1 else rows[rows["axis"] == number])

    def _add_host_times(self, rows: Rows) -> None:
        due_at, woke_at, compute = rows["due_at"], rows["woke_at"], rows["compute_ns"]
        woken = woke_at != NOTHING
        lateness = woke_at[woken] - due_at[woken]
        self._lateness.add(lateness)
        self._latest.look(due_at[woken], lateness)
        computed = compute != NOTHING
        self._compute.add(compute[computed])
        self._longest.look(due_at[computed], compute[computed])

    def take_events(self) -> list[TextEvent]:
        """Return the notable events in the rows since the last call."""
        told = [(at, axis.axis.name, text) for axis in self._axes for at, text in axis.events()]
        return [TextEvent(Instant(at), "WARN", f"{axis}: {text}") for at, axis, text in sorted(told)]

    def figures(self) -> Figures:
        """The figures of all rows so far."""
        count = {cause: int(self._fates[place]) for place, cause in enumerate(CAUSES, start=1)}
        least, most = self.network.action_delays()
        networks = self.network.axes
        known = any(each.commands_known for each in networks)
        return Figures(
            cycles=max((axis.rows for axis in self._axes), default=0),
            rows=int(self._fates.sum()),
            dense=min((axis.dense for axis in self._axes), default=0),
            dropouts=DropoutCounts(**{cause.value: number for cause, number in count.items()}),
            reading_delay_us=_percentiles_us(merged(self.delays)),
            action_delay_us=_percentiles_us(most),
            action_delay_least_us=_percentiles_us(least),
            speed_error=worst(SpeedError, [meter.figures() for meter in self.errors]),
            lateness_us=_percentiles_us(self._lateness),
            compute_us=_percentiles_us(self._compute),
            digest=self._digest.hexdigest(),
            position_error=worst(PositionError, [meter.figures() for meter in self.positions]),
            torque_rms_nm=largest(axis.swing.worst.value for axis in self._axes),
            step_response=worst_steps([axis.steps for axis in self._axes]),
            reading_losses_in_a_row=max(each.readings_lost.most for each in networks),
            command_losses_in_a_row=max(each.commands_lost.most for each in networks) if known else None,
            command_losses_in_a_row_least=max(each.commands_lost_least.most for each in networks)
            if known
            else None,
            certificates={
                axis.axis.name: axis.certificate.figures()
                for axis in self._axes
                if axis.certificate is not None
            },
            worst=self._worst(),
        )

    def _worst(self) -> dict[str, WorstPlace]:
        """Where the values of the limits come from, by the limits' names; those that have one place."""
        worst: dict[str, tuple[float, str, int | None]] = {}
        for axis in self._axes:
            for name, (value, at) in axis.places().items():
                if value is not None and (name not in worst or value > worst[name][0]):
                    worst[name] = value, axis.axis.name, at
        for name, time in (("lateness_us_max", self._latest), ("compute_us_max", self._longest)):
            if time.value is not None:
                worst[name] = time.value, "", time.at
        zero = self._zero or 0
        return {
            name: WorstPlace(axis, None if at is None else at - zero) for name, (_, axis, at) in worst.items()
        }


def _percentiles_us(times: TimeHistogram) -> Percentiles:
    p50, p99, largest = times.quantile_ns(0.50), times.quantile_ns(0.99), times.largest_ns
    if p50 is None or p99 is None or largest is None:
        return Percentiles(None, None, None)
    return Percentiles(p50 / NS_PER_US, p99 / NS_PER_US, largest / NS_PER_US)
