"""Measure what a run did to the loop of a certified controller, beside what its certificate allows.

The certificate is of the gain from load torque to speed error. The energy of the error up to any instant is
then at most gain^2 times that of the load: for a load step in a steady run, the rms of the error since the
step, over the torque of the step, is at most the gain at every instant. That is what is seen of it here:

    load       ___________/~~~~~~~~~~~~~~~~~~~~~
    error      |  mean  ||  rms about that mean, of ever longer times: the largest counts

The noise of the speed is in it too, so a gain that is seen is a little high. What the error did about its
mean before the step it goes on doing, whatever the load does to it; so the rms may be larger by the largest
of that, and not by more. A gain *at least* is what is left of the rms when so much is taken off.

What a certificate presumes, a premise, is *left* where it certainly was not kept, and *not known* where the
rows cannot tell: a drive whose commands are read back at SYNCs says between which two of them a command began
to act, and no more. Only a run with neither may be held against it. In words each begins with its name and a
colon.
"""

import math
from collections.abc import Iterator, Mapping
from enum import StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.cia402.profile import Status
from servobench.drivers.timebase import NS_PER_US
from servobench.hil.loop.cycle_record import FATE_SAMPLE, NOTHING
from servobench.hil.reviewing.histogram import TimeHistogram
from servobench.hil.reviewing.network_meter import ACTING, LOST, AxisNetworkMeter, action_delays_ns
from servobench.hil.reviewing.sync_meter import SyncMeter, sync_instants
from servobench.hil.rows.recording_plan import AxisPlan, CertifiedPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows

_ROUNDING = 1e-9
"""A command at the limit is the limit but for rounding; no command in N m is set as finely."""
_EXACT_US = 10.0
"""By which a constant delay may be missed, either way: what two clocks that are matched leave open of it."""


class PremisesMeter:
    """Checks whether a run stayed within its certificate's premises.

    Feed it rows of its axis in order of sequence; any division into chunks gives the same.
    """

    def __init__(self, axis: AxisPlan, certified: CertifiedPlan, network: AxisNetworkMeter) -> None:
        """``network``: of the axis, which has been given the same rows whenever this one is asked."""
        self._axis, self._certified, self._network = axis, certified, network
        self._syncs = SyncMeter(certified.period_us, certified.sync_within_us)
        self._missing = 0
        self._age_us = 0.0
        """The longest for which a sample acted, at least; losses included."""
        self._command_nm = 0.0
        self.saturated = 0
        """Cycles of the stretches that are held against the certificate with a command at a limit."""
        self._behind = int((certified.delay_us or 0.0) // certified.period_us)
        """SYNCs from a sample to the last one before its command acts, in a certificate for lost samples."""
        self._before = np.zeros(0, ROW_DTYPE)
        """So many of the last rows."""
        self._shortest_us, self._longest_us = math.inf, -math.inf
        """From sample to actuator, as if SYNCs were even: the shortest was so long at most, the longest at
        least."""

    def add(self, rows: Rows) -> None:
        """Take in rows: (n,) of ROW_DTYPE, at least one."""
        self._syncs.add(rows)
        if self._certified.samples_alone:
            self._add_actions(rows)
        # a sample acts until the next one does: its own delay, a period, and one more for each loss
        period_ns = self._certified.period_us * NS_PER_US
        came = np.flatnonzero(rows["fate"] == FATE_SAMPLE)
        if not came.size:
            self._missing += rows.size
            return
        missing: NDArray[np.int64] = np.diff(came, prepend=-1) - 1
        missing[0] += self._missing
        self._missing = int(rows.size - 1 - came[-1])
        samples = rows.take(came)
        least, _ = action_delays_ns(samples, period_ns)
        if least.size:
            acting = samples["command_fate"] == ACTING
            self._age_us = max(
                self._age_us, float(((missing[acting] + 1) * period_ns + least).max()) / NS_PER_US
            )

    def _add_actions(self, rows: Rows) -> None:
        """Take in when commands acted, counted from the SYNC ``_behind`` after their sample's: that is what
        is constant where commands act at SYNCs, whose distances vary."""
        rows = np.concatenate((self._before, rows))
        followed = max(0, rows.size - self._behind)
        self._before = rows[followed:]
        first, last = rows[:followed], rows[self._behind :]
        came = (first["fate"] == FATE_SAMPLE) & (first["command_fate"] == ACTING)
        if not came.any():
            return
        first, ends, period_ns = first[came], sync_instants(last)[came], self._certified.period_us * NS_PER_US
        least, most = action_delays_ns(first, period_ns)
        shift = np.where(ends == NOTHING, 0, ends - first["sampled_at"] - self._behind * period_ns)
        self._shortest_us = min(self._shortest_us, float((most - shift).min()) / NS_PER_US)
        self._longest_us = max(self._longest_us, float((least - shift).max()) / NS_PER_US)

    def count_limited(self, rows: Rows, held: bool) -> None:
        """Take in the same rows once more, stretch by stretch; ``held``: whether this one is held against
        the certificate."""
        command = rows["command_torque_nm"]
        command = command[np.isfinite(command)]
        limit = self._axis.torque_max_nm
        if held:
            at_limit = (rows["statusword"] != NOTHING) & (
                rows["statusword"] & int(Status.INTERNAL_LIMIT_ACTIVE) != 0
            )
            self.saturated += int(np.count_nonzero(at_limit))
            if limit is not None:
                self.saturated += int(np.count_nonzero(np.abs(command) >= limit * (1.0 - _ROUNDING)))
            if (most := self._certified.torque_step_max_nm) is not None:
                steps = np.abs(np.diff(command, prepend=self._command_nm))
                self.saturated += int(np.count_nonzero(steps >= most * (1.0 - _ROUNDING)))
        if command.size:
            self._command_nm = float(command[-1])

    @property
    def delay_us(self) -> tuple[float | None, float | None]:
        """Delay to actuation: the longest was at least, and at most, so long; None: not known."""
        least, most = self._network.actions(self._network.stamped())
        return _largest_us(least), _largest_us(most)

    def left(self) -> Iterator[str]:
        """Premises that certainly were not kept, in words."""
        certified = self._certified
        yield from certified.left
        delay, losses, age = certified.delay_us, certified.losses_together, certified.age_us
        least_us, _ = self.delay_us
        least, _ = self._network.losses_together
        long = delay is not None and least_us is not None and least_us > delay
        often = losses is not None and least > losses
        if long:
            yield f"delay: {least_us:.1f} us from sample to actuator, made for {delay:g} us"
        if often:
            yield f"losses: {least} in a row, readings and commands together, made for at most {losses}"
        if not (long or often) and age is not None and self._age_us > age:
            yield f"age: a sample that acts for {self._age_us:.1f} us, made for at most {age:g} us"
        if self._syncs.left:
            yield self._syncs.told()
        if certified.samples_alone:
            yield from self._left_by_commands()
        if self.saturated:
            yield f"saturation: {self.saturated} commands at a limit after a load step"

    def _left_by_commands(self) -> Iterator[str]:
        """Yield the premises on commands, in a certificate for lost samples, that the run left."""
        certified = self._certified
        if lost := int(self._network.command_fates[LOST]):
            yield f"commands: {lost} lost, certified where every one arrives"
        if certified.delay_us is None:
            return
        delay_us = certified.delay_us - self._behind * certified.sync_within_us
        for seen_us, missed_us in (
            (self._shortest_us, delay_us - self._shortest_us),
            (self._longest_us, self._longest_us - delay_us),
        ):
            if missed_us > _EXACT_US:
                yield (
                    f"constant delay: {seen_us:.1f} us from sample to actuator, certified for "
                    f"{delay_us:g} us alone"
                )
                return

    def unknown(self) -> Iterator[str]:
        """Premises of which the rows do not tell whether they were kept, in words."""
        yield from self._certified.unknown
        limit, (least_us, most_us) = self._certified.delay_us, self.delay_us
        losses, (least, most) = self._certified.losses_together, self._network.losses_together
        if losses is not None and least <= losses < most:
            yield (
                f"losses: {least} to {most} in a row, readings and commands together, "
                f"made for at most {losses}"
            )
        if self._certified.samples_alone and (passed := self._network.passed):
            yield (
                f"commands: {passed} lost, or followed between two SYNCs only; "
                "certified where every one arrives"
            )
        if limit is None:
            return
        if most_us is None:
            yield "delay: from sample to actuator nothing was measured"
        elif (
            most_us > limit + (_EXACT_US if self._certified.samples_alone else 0.0)
            and not (least_us or 0.0) > limit
        ):
            yield (
                f"delay: {least_us:.1f} to {most_us:.1f} us from sample to actuator, made for "
                f'{limit:g} us (loop.command_readback = "event" tells it)'
            )


def _largest_us(times: TimeHistogram) -> float | None:
    largest = times.largest_ns
    return None if largest is None else largest / NS_PER_US


_STEP_MIN: Final = 0.01
"""Smallest step of load, as a share of the rated torque. Below it, as where a load from a file sets in, the
noise of the speed is larger than the answer, and their ratio says nothing of the gain."""
_BEFORE: Final = 20
"""Readings of a steady run of which the mean before a load step is taken, at least: it is the speed error
that friction or the load of before leaves to a controller that does not integrate."""


class CertificateState(StrEnum):
    """State of a certificate after a run. For several axes the first in this list is reported."""

    EXCEEDED = "exceeded"
    """A counter-example: all premises were kept, and the certified figure was not."""
    LEFT = "premise left"
    NOT_KNOWN = "premises not known"
    NOT_MEASURED = "not measured"
    """No certified figure, or no load step in a steady run."""
    KEPT = "kept"


class CertificateMeter:
    """Feed it rows of its axis in order of sequence; any division into chunks gives the same figures."""

    def __init__(self, axis: AxisPlan, settling_ns: int, network: AxisNetworkMeter) -> None:
        """``axis``: one with a certified controller; ``network``: see :class:`PremisesMeter`."""
        assert axis.certified is not None
        self._certified, self._network = axis.certified, network
        self._premises = PremisesMeter(axis, axis.certified, network)
        self._settling_ns = settling_ns
        self._step_min_nm = _STEP_MIN * (axis.rated_torque_nm or 0.0)
        self._reference = self._load = 0.0
        self._changed_at: int | None = None
        self._before_sum, self._before = 0.0, 0
        self._before_low, self._before_high = math.inf, -math.inf
        self._step_nm = self._mean = self._noise = 0.0
        self._square_sum, self._since = 0.0, 0
        self.gain_seen: float | None = None
        """rad/s per N m; None: no load has changed in a steady run."""
        self.gain_least: float | None = None
        """The same, less what noise may make of it."""
        self._told = False
        self._exceeded: tuple[int, str] | None = None

    def add(self, rows: Rows) -> None:
        """Take in rows: (n,) of ROW_DTYPE."""
        if not rows.size:
            return
        self._premises.add(rows)
        for part in _stretches(rows):
            self._enter(float(part["reference_rad_s"][0]), float(part["load_torque_nm"][0]), part)
            self._take(part)

    def figures(self) -> dict[str, Any]:
        """For JSON: certified and seen, by what is certified."""
        certified, premises = self._certified, self._premises
        least_us, most_us = premises.delay_us
        least, most = self._network.losses_together
        left, unknown = list(premises.left()), list(premises.unknown())
        return {
            # by SYNC read-backs a command is known to act between two SYNCs only
            "action_delay_us": {**_pair(certified.delay_us, least_us), "seen_at_most": most_us},
            "losses_together": {**_pair(certified.losses_together, least), "seen_at_most": most},
            "gain_rad_s_nm": {**_pair(certified.gain, self.gain_seen), "seen_at_least": self.gain_least},
            "current_bandwidth_hz": {
                "certified": None if certified.bandwidths_hz is None else list(certified.bandwidths_hz),
                "drive": certified.bandwidth_hz,
            },
            "commands_at_a_limit": premises.saturated,
            "premises_left": left,
            "premises_unknown": unknown,
            "state": self._state(left, unknown).value,
        }

    def _state(self, left: list[str], unknown: list[str]) -> CertificateState:
        if left:
            return CertificateState.LEFT
        if unknown:
            return CertificateState.NOT_KNOWN
        if self._certified.gain is None or self.gain_least is None:
            return CertificateState.NOT_MEASURED
        exceeded = self.gain_least > self._certified.gain
        return CertificateState.EXCEEDED if exceeded else CertificateState.KEPT

    def _enter(self, reference: float, load: float, part: Rows) -> None:
        """A stretch begins, or goes on from the last chunk."""
        if self._changed_at is not None and (reference, load) == (self._reference, self._load):
            return
        steady = reference == self._reference and self._before >= _BEFORE
        step_nm = load - self._load
        self._step_nm = step_nm if steady and abs(step_nm) >= self._step_min_nm else 0.0
        self._mean = self._before_sum / self._before if self._before else 0.0
        self._noise = max(self._mean - self._before_low, self._before_high - self._mean, 0.0)
        self._square_sum, self._since = 0.0, 0
        self._before_sum, self._before = 0.0, 0
        self._before_low, self._before_high = math.inf, -math.inf
        self._reference, self._load, self._changed_at = reference, load, int(part["due_at"][0])

    def _take(self, part: Rows) -> None:
        assert self._changed_at is not None
        self._premises.count_limited(part, self._step_nm != 0.0)
        came = part.compress(part["fate"] == FATE_SAMPLE)
        if not came.size:
            return
        error = self._reference - came["velocity_rad_s"]
        settled = error[came["due_at"] - self._changed_at >= self._settling_ns]
        self._before_sum = _added(self._before_sum, settled)
        self._before += settled.size
        self._before_low = min(self._before_low, float(settled.min(initial=math.inf)))
        self._before_high = max(self._before_high, float(settled.max(initial=-math.inf)))
        if self._step_nm == 0.0:
            return
        squares = np.cumsum(np.concatenate(([self._square_sum], (error - self._mean) ** 2)))[1:]
        rms = np.sqrt(squares / np.arange(self._since + 1, self._since + 1 + squares.size))
        seen = float(rms.max()) / abs(self._step_nm)
        self.gain_seen = max(seen, self.gain_seen or 0.0)
        least = max(0.0, float(rms.max()) - self._noise) / abs(self._step_nm)
        self.gain_least = max(least, self.gain_least or 0.0)
        self._hold_against(rms, came["due_at"])
        self._square_sum, self._since = float(squares[-1]), self._since + squares.size

    def take_exceeded(self) -> tuple[int, str] | None:
        """When the gain was first above the certified one, noise apart, ns, and in words; told once."""
        exceeded, self._exceeded = self._exceeded, None
        return exceeded

    def _hold_against(self, rms: NDArray[np.float64], due_at: NDArray[np.int64]) -> None:
        gain = self._certified.gain
        if self._told or gain is None:
            return
        above = np.flatnonzero(rms - self._noise > gain * abs(self._step_nm))
        if above.size:
            self._told = True
            seen = float(rms[above[0]]) / abs(self._step_nm)
            text = f"the gain from load to speed error is {seen:.4g} rad/s per N m, certified {gain:.4g}"
            self._exceeded = int(due_at[above[0]]), text


def _stretches(rows: Rows) -> Iterator[Rows]:
    """The rows, divided where reference or load change."""
    changed = (np.diff(rows["reference_rad_s"]) != 0.0) | (np.diff(rows["load_torque_nm"]) != 0.0)
    yield from np.split(rows, np.flatnonzero(changed) + 1)


def _added(total: float, values: NDArray[np.float64]) -> float:
    """From left to right, so that the sum does not depend on the chunk."""
    return float(np.cumsum(np.concatenate(([total], values)))[-1])


def _pair(certified: float | None, seen: float | None) -> Mapping[str, float | None]:
    return {"certified": certified, "seen": seen}
