"""The control loop: one thread, one SYNC a cycle, all axes.

    tick         due                  decide_at                        next due
    host          | SYNC ....... decide, RPDO ............................ |
    drive            | sample, TPDOs       | set-point acts

Time passes only inside ``network.pump`` and ``network.pump_one``, which wait in the
bus's ``recv``; on hardware that blocks, in simulation it steps the event heap. The
loop cannot tell which.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from drivers.errors import NoAnswer
from drivers.exchange import Master
from drivers.timebase import NS_PER_S, Clock, Duration, Instant
from hil.axis import Axis, Tick
from hil.ticker import next_tick

CALIBRATION_SYNCS: Final = 16
PROGRESS_EVERY_CYCLES: Final = 50


class Actuation(Enum):
    """When a drive applies a set-point."""

    ON_ARRIVAL = "on_arrival"
    ON_SYNC = "on_sync"


@dataclass(frozen=True, slots=True)
class LoopTiming:
    """The loop's times, all ns."""

    period: Duration
    decide_after: Duration
    """The command is computed no later than this after the tick."""
    settle: Duration
    """How long readings may still come in after the last cycle."""
    actuation: Actuation
    sync_latency: Duration
    """From handing a SYNC over until its end on an idle bus."""
    command_latency: Duration
    """The same for a command."""


@dataclass(frozen=True, slots=True)
class LoopOutcome:
    """How a run ended."""

    cycles: int
    ticks_missed: int
    started_at: Instant
    ended_at: Instant
    interrupted: bool


class Loop:
    """Runs axes on one bus."""

    def __init__(
        self,
        network: Master,
        clock: Clock,
        axes: Sequence[Axis],
        timing: LoopTiming,
        chore: Callable[[Instant], None] | None = None,
    ) -> None:
        """``chore``: done at the end of each cycle, when the commands are out; it must not wait."""
        self._network = network
        self._now = clock.now
        self._axes = tuple(axes)
        self._timing = timing
        self._chore = chore
        self._started_at = Instant(0)

    def calibrate(self) -> None:
        """Learn the drives' clocks from SYNCs so far apart that each reading answers the last one.

        Raises ``NoAnswer`` if an axis stays silent throughout.
        """
        answered = [False] * len(self._axes)
        for _ in range(CALIBRATION_SYNCS):
            sent_at = self._network.send_sync()
            self._network.pump(Instant(sent_at + self._timing.settle))
            for number, axis in enumerate(self._axes):
                answered[number] |= axis.calibrate(sent_at)
        for axis, came in zip(self._axes, answered, strict=True):
            if not came:
                raise NoAnswer(
                    f"{axis.parts.name}: no reading came in answer to {CALIBRATION_SYNCS} SYNCs",
                    remedy="check that the drive is operational and that its TPDOs are synchronous",
                )

    def run(
        self,
        duration: Duration,
        should_stop: Callable[[], bool],
        on_start: Callable[[Instant], None],
        progress: Callable[[int], None],
    ) -> LoopOutcome:
        """Run the cycles of ``duration``; ``progress`` is given the number done so far.

        Raises ``LimitExceeded`` when a safety limit is crossed; the caller brings the drives to rest.
        """
        timing = self._timing
        period = timing.period
        due = Instant(self._now() + period)
        end = Instant(due + duration)
        self._started_at = due
        on_start(due)
        cycles = ticks_missed = 0
        interrupted = False
        try:
            while due < end:
                if should_stop():
                    interrupted = True
                    break
                self._cycle(due)
                cycles += 1
                if cycles % PROGRESS_EVERY_CYCLES == 0:
                    progress(cycles)
                due, missed = next_tick(due, period, self._now())
                ticks_missed += missed
            ended_at = self._now()
            self._drain(interrupted)
        finally:
            for axis in self._axes:
                axis.settle_all()
        return LoopOutcome(cycles, ticks_missed, self._started_at, ended_at, interrupted)

    def _cycle(self, due: Instant) -> None:
        network, axes = self._network, self._axes
        network.pump(due)
        woke_at = self._now()
        sync_sent_at = network.send_sync()
        tick = Tick(network.sync_count, due, woke_at, sync_sent_at, (due - self._started_at) / NS_PER_S)
        for axis in axes:
            axis.begin(tick)
        self._await_readings(tick)
        for axis in axes:
            axis.decide(tick, self._apply_at(due))
        for axis in axes:
            axis.settle()
        if self._chore is not None:
            self._chore(self._now())

    def _await_readings(self, tick: Tick) -> None:
        network, axes, decide_after = self._network, self._axes, self._timing.decide_after
        decide_at = Instant(tick.due_at + decide_after)
        sequence = tick.sequence
        while True:
            ready = True
            for axis in axes:
                axis.collect()
                ready = ready and axis.has_expected(sequence, decide_after)
            if ready or not network.pump_one(decide_at):
                return

    def _apply_at(self, due: Instant) -> Instant:
        timing = self._timing
        if timing.actuation is Actuation.ON_SYNC:
            return Instant(due + timing.period + timing.sync_latency)
        return Instant(self._now() + timing.command_latency)

    def _drain(self, interrupted: bool) -> None:
        """Let the readings that are still on their way come in; not when the drives must stop at once."""
        if interrupted:
            return
        self._network.pump(Instant(self._now() + self._timing.settle))
        for axis in self._axes:
            axis.collect()
