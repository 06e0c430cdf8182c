"""Whether a run stayed within what the certificate of a controller presumes, from its rows.

A premise is *left* where it certainly was not kept, and *not known* where the rows cannot tell: a drive whose
commands are read back at SYNCs says between which two of them a command began to act, and no more. Only a run
with neither may be held against what is certified. In words each begins with its name and a colon.
"""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from drivers.cia402.profile import Status
from drivers.timebase import NS_PER_US
from hil.reviewing.network_meter import ACTING, LOST, NetworkMeter, action_delays_ns
from hil.rows.recording_plan import AxisPlan, CertifiedPlan
from hil.rows.records import FATE_SAMPLE, NOTHING, Rows

_ROUNDING = 1e-9
"""A command at the limit is the limit but for rounding; no command in N m is set as finely."""
_EXACT_US = 10.0
"""By which a constant delay may be missed, either way: what two clocks that are matched leave open of it."""


class PremisesMeter:
    """Feed it rows of its axis in order of sequence; any division into chunks gives the same."""

    def __init__(self, axis: AxisPlan, certified: CertifiedPlan) -> None:
        self._axis, self._certified = axis, certified
        self._network = NetworkMeter(certified.period_us, 1)
        self._missing = 0
        self._age_us = 0.0
        """The longest for which a sample acted, at least; losses included."""
        self._command_nm = 0.0
        self.saturated = 0
        """Cycles of the stretches that are held against the certificate with a command at a limit."""
        self._commands_lost = 0
        self._shortest_us = math.inf
        """From sample to actuator: the shortest was so long at most."""
        self.delay_least_us: float | None = None
        self.delay_most_us: float | None = None
        """From sample to actuator: the longest was at least, and at most, so long; None: not known."""
        self.losses: int | None = None

    def add(self, rows: Rows) -> None:
        """Take in rows: (n,) of ROW_DTYPE, at least one."""
        mine = rows.copy()
        mine["axis"] = 0
        self._network.add(mine)
        self._add_ages(rows)

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

    def look(self) -> None:
        """Bring the figures up to the rows so far."""
        network = self._network.network()
        if network is None:
            return
        least, most = network.action_delay_least_us, network.action_delay_us
        self.delay_least_us = None if least is None else least.max
        self.delay_most_us = None if most is None else most.max
        self.losses = network.losses_max

    def left(self) -> Iterator[str]:
        """Premises that certainly were not kept, in words; of the rows at the last :meth:`look`."""
        certified = self._certified
        yield from certified.left
        delay, losses, age = certified.delay_us, certified.losses_in_a_row, certified.age_us
        long = delay is not None and self.delay_least_us is not None and self.delay_least_us > delay
        often = losses is not None and self.losses is not None and self.losses > losses
        if long:
            yield f"delay: {self.delay_least_us:.1f} us from sample to actuator, made for {delay:g} us"
        if often:
            yield f"losses: {self.losses} in a row, made for at most {losses}"
        if not (long or often) and age is not None and self._age_us > age:
            yield f"age: a sample that acts for {self._age_us:.1f} us, made for at most {age:g} us"
        if certified.samples_alone:
            yield from self._left_by_commands(delay)
        if self.saturated:
            yield f"saturation: {self.saturated} commands at a limit after a load step"

    def _left_by_commands(self, delay_us: float | None) -> Iterator[str]:
        """What a certificate for lost samples presumes of the commands."""
        if self._commands_lost:
            yield f"commands: {self._commands_lost} lost, certified where every one arrives"
        if delay_us is not None and self._shortest_us < delay_us - _EXACT_US:
            yield (
                f"constant delay: {self._shortest_us:.1f} us from sample to actuator, certified for "
                f"{delay_us:g} us alone"
            )

    def unknown(self) -> Iterator[str]:
        """Premises of which the rows do not tell whether they were kept, in words."""
        yield from self._certified.unknown
        limit, most = self._certified.delay_us, self.delay_most_us
        if limit is None:
            return
        if most is None:
            yield "delay: from sample to actuator nothing was measured"
        elif (
            most > limit + (_EXACT_US if self._certified.samples_alone else 0.0)
            and not (self.delay_least_us or 0.0) > limit
        ):
            yield (
                f"delay: {self.delay_least_us:.1f} to {most:.1f} us from sample to actuator, made for "
                f'{limit:g} us (loop.command_readback = "event" tells it)'
            )

    def _add_ages(self, rows: Rows) -> None:
        """A sample acts until the next one does: its own delay, a period, and one more for each loss."""
        period_ns = self._certified.period_us * NS_PER_US
        self._commands_lost += int(np.count_nonzero(rows["command_fate"] == LOST))
        came = np.flatnonzero(rows["fate"] == FATE_SAMPLE)
        if not came.size:
            self._missing += rows.size
            return
        missing: NDArray[np.int64] = np.diff(came, prepend=-1) - 1
        missing[0] += self._missing
        self._missing = int(rows.size - 1 - came[-1])
        samples = rows[came]
        least, most = action_delays_ns(samples, period_ns)
        if least.size:
            self._shortest_us = min(self._shortest_us, float(most.min()) / NS_PER_US)
            acting = samples["command_fate"] == ACTING
            self._age_us = max(
                self._age_us, float(((missing[acting] + 1) * period_ns + least).max()) / NS_PER_US
            )
