"""The figures of a run, computed from its packed records in bounded memory, chunk by chunk.

How an axis answers to a step of its reference, and how it comes back after a step of its load.

    reference  ____/~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
    speed         .'``'-.__-------.   .----------
    load       ___________________/~`'~~~~~~~~~~~
                   |settling| 2 % of the step
                                  |recovery| 2 % of the reference

A step counts until reference or load change again. What counts as a step of the reference is what opens a
settling window (:mod:`servobench.hil.reviewing.tracking_error`). One that was not within its band when it
ended has no time: then none is told, for a time that is not known is not the largest of those that are.
"""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration, Instant
from servobench.hil.loop.cycle_record import CAUSES, FATE_SAMPLE, NAMES, NOTHING
from servobench.hil.reviewing.certificate_meter import CertificateMeter
from servobench.hil.reviewing.envelope import Largest, largest
from servobench.hil.reviewing.histogram import TimeHistogram, merged
from servobench.hil.reviewing.network_meter import AxisNetworkMeter, NetworkMeter
from servobench.hil.reviewing.torque_swing import TorqueSwingMeter
from servobench.hil.reviewing.tracking_error import AskedChanges, PositionErrorMeter, SpeedErrorMeter, worst
from servobench.hil.rows.recording_plan import AxisPlan, ReviewPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.side_rows import TextEvent
from servobench.hil.verdict.figures import (
    DropoutCounts,
    Figures,
    Percentiles,
    PositionError,
    SpeedError,
    StepResponse,
    WorstPlace,
)
from servobench.hil.verdict.metrics import VerdictLimits

DIGEST_BYTES = 16
"""128 bits: of 2^64 runs two are alike by chance."""


class _AxisMeters:
    """Meters of one axis."""

    def __init__(self, axis: AxisPlan, plan: ReviewPlan, network: AxisNetworkMeter) -> None:
        self.axis = axis
        self.network = network
        self.error = SpeedErrorMeter(axis, plan.settling)
        self.steps = StepMeter(axis, plan.band_percent, plan.limits, plan.period)
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
            "following_error_peak_rad_max": (
                self.position.following.peak.value,
                self.position.following.peak.at,
            ),
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
        self.steps = [axis.steps for axis in self._axes]
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
            axis.add(rows if len(self._axes) == 1 else rows.compress(rows["axis"] == number))

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


_WINDOWS_MAX: Final = 100
"""More windows of broken limits cannot be told apart in a picture."""


class _Step(NamedTuple):
    at: int
    of_load: bool
    target: float
    size: float
    """Size of the reference's step, with its sign; for a load that of the reference."""


class StepMeter:
    """Feed it rows of its axis in order of sequence; any division into chunks gives the same figures."""

    def __init__(
        self,
        axis: AxisPlan,
        band_percent: float,
        limits: VerdictLimits | None = None,
        period: Duration = Duration(NS_PER_MS),  # noqa: B008 - an int
    ) -> None:
        """``band_percent``: of the step, or of the reference: within it the speed has settled. ``limits``,
        ``period`` of the loop: for the windows in which a limit was broken."""
        self._band = band_percent / 100.0
        self._limits, self._period = limits or VerdictLimits(), period
        self._over_window: tuple[int, int] | None = None
        """First and last cycle beyond the limit of the overshoot, since the step that is open."""
        self._late: list[tuple[int, int]] = []
        self._overshot: list[tuple[int, int]] = []
        self._asked = AskedChanges(axis.acceleration_max_rad_s2)
        self._open: _Step | None = None
        self._outside_at = self._seen_at = 0
        self._overshoot_rad_s = 0.0
        self._lasted = 0
        """Cycles since the step that is open."""
        self._settling, self._recovery, self._over = Largest(), Largest(), Largest()
        self._unsettled = [False, False]
        """A step of the reference, or of the load, did not come into its band."""

    def add(self, rows: Rows) -> None:
        """Take in rows: (n,) of ROW_DTYPE."""
        if not rows.size:
            return
        reference, due_at = rows["reference_rad_s"], rows["due_at"]
        step, load_step, stepped = self._asked.take(rows)
        loaded = (step == 0.0) & (load_step != 0.0) & (reference != 0.0)
        changes = np.append(np.flatnonzero((step != 0.0) | (load_step != 0.0)), rows.size)
        self._take(rows[: changes[0]])
        if changes.size > 1:
            self._close()
        # of a ramp every cycle is a change, and none is looked at; the last one may go on in the next rows
        stays = np.diff(changes) > 1
        stays[-1:] = True
        for place in np.flatnonzero(stepped[changes[:-1]] | (loaded[changes[:-1]] & stays)):
            start, end = int(changes[place]), int(changes[place + 1])
            of_load = bool(loaded[start])
            target = float(reference[start])
            self._open = _Step(int(due_at[start]), of_load, target, target if of_load else float(step[start]))
            self._outside_at, self._seen_at = self._open.at, -1
            self._overshoot_rad_s, self._lasted, self._over_window = 0.0, 0, None
            self._take(rows[start:end])
            if end < rows.size:
                self._close()

    def figures(self) -> StepResponse:
        """Return the figures of all steps so far, with the one that goes on."""
        if self._open is not None:
            self._look(self._open)
        return StepResponse(
            settling_time_ms=None if self.unsettled[False] else self._settling.value,
            overshoot_percent=self._over.value,
            recovery_time_ms=None if self.unsettled[True] else self._recovery.value,
        )

    @property
    def unsettled(self) -> list[bool]:
        """Tell whether a step of the reference, and one of the load, did not come into its band."""
        counts = list(self._unsettled)
        if self._open is not None:
            counts[self._open.of_load] |= self._outside_at == self._seen_at
        return counts

    @property
    def late(self) -> list[tuple[int, int]]:
        """Return from when to when the speed was outside its band later than a limit allows, ns."""
        return self._until_next_cycle(self._late, self._late_window())

    @property
    def overshot(self) -> list[tuple[int, int]]:
        """Return from when to when a step overshot its limit, ns."""
        return self._until_next_cycle(self._overshot, self._over_window if self._open else None)

    def _until_next_cycle(
        self, closed: list[tuple[int, int]], goes_on: tuple[int, int] | None
    ) -> list[tuple[int, int]]:
        windows = closed if goes_on is None else [*closed, goes_on]
        return [(first, last + self._period) for first, last in windows]

    @property
    def instants(self) -> tuple[int | None, int | None, int | None]:
        """When the steps were that the figures come from, ns, in their order."""
        return self._settling.at, self._over.at, self._recovery.at

    def _take(self, rows: Rows) -> None:
        step = self._open
        self._lasted += rows.size
        came = rows.compress(rows["fate"] == FATE_SAMPLE)
        if step is None or not came.size:
            return
        beyond: NDArray[np.float64] = (came["velocity_rad_s"] - step.target) * math.copysign(1.0, step.size)
        outside = np.flatnonzero(np.abs(beyond) > self._band * abs(step.size))
        if outside.size:
            self._outside_at = int(came["due_at"][outside[-1]])
        self._seen_at = int(came["due_at"][-1])
        self._overshoot_rad_s = max(self._overshoot_rad_s, float(beyond.max()))
        most = self._limits.overshoot_percent_max
        if most is not None and not step.of_load:
            over = came["due_at"].compress(100.0 * beyond > most * abs(step.size))
            if over.size:
                first = int(over[0]) if self._over_window is None else self._over_window[0]
                self._over_window = first, int(over[-1])

    def _close(self) -> None:
        if self._open is not None and not (self._open.of_load and self._lasted == 1):
            self._look(self._open)
            if self._outside_at == self._seen_at:
                self._unsettled[self._open.of_load] = True
            for kept, window in ((self._late, self._late_window()), (self._overshot, self._over_window)):
                if window is not None and len(kept) < _WINDOWS_MAX:
                    kept.append(window)
        self._open = None  # a load that changes from cycle to cycle makes no steps

    def _late_window(self) -> tuple[int, int] | None:
        """First and last cycle outside the band that came later than the limit of the step that is open."""
        if self._open is None:
            return None
        limits = self._limits
        most = limits.recovery_time_ms_max if self._open.of_load else limits.settling_time_ms_max
        begin = self._open.at + round((most or 0.0) * NS_PER_MS)
        return None if most is None or self._outside_at <= begin else (begin, self._outside_at)

    def _look(self, step: _Step) -> None:
        time_ms = (self._outside_at - step.at) / NS_PER_MS
        (self._recovery if step.of_load else self._settling).note(step.at, time_ms)
        if not step.of_load:
            self._over.note(step.at, 100.0 * self._overshoot_rad_s / abs(step.size))


def worst_steps(meters: Sequence[StepMeter]) -> StepResponse:
    """The largest of each figure over the axes; None where a step of any axis did not settle."""
    settled, recovered = (not any(meter.unsettled[of_load] for meter in meters) for of_load in (False, True))
    response = worst(StepResponse, [meter.figures() for meter in meters])
    return replace(
        response,
        settling_time_ms=response.settling_time_ms if settled else None,
        recovery_time_ms=response.recovery_time_ms if recovered else None,
    )
