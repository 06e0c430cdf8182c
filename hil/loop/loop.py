"""The control loop: one thread, one SYNC a cycle, all axes.

    tick         due                  decide_at                        next due
    host          | SYNC ....... decide, RPDO ......... rest ............. |
    drive            | sample, TPDOs       | set-point acts

Time passes only inside ``network.rest``, ``network.pump`` and ``network.pump_one``, which wait in the
bus's ``recv``; on hardware that blocks, in simulation it steps the event heap. The
loop cannot tell which.

Every tick is a cycle and has a fate, also one that goes without SYNC. What a tick is, and who makes its SYNC,
is the business of the loop's pace (:mod:`servobench.hil.loop.pace`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from servobench.drivers.errors import LimitExceeded, NoAnswer
from servobench.drivers.exchange import Master
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Clock, Duration, Instant
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.delay import Tick
from servobench.hil.loop.pace import Pace, Start, ticks_passed

PROGRESS_EVERY: Final = 50 * NS_PER_MS
"""Time between two calls of progress, ns: so rare a call may enter the kernel, which no single cycle does."""
BEYOND_ANY_HORIZON: Final = 1 << 30
"""More cycles than the longest run, a day, has at the shortest period, 100 us: 8.6e8."""


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
    """From a tick until the end of its SYNC on an idle bus: none where that is the tick."""
    command_latency: Duration
    """The same for a command."""


@dataclass(frozen=True, slots=True)
class LoopOutcome:
    """How a run ended."""

    cycles: int
    """Planned cycles that have a fate."""
    cycles_missed: int
    """Those without SYNC."""
    started_at: Instant
    last_due_at: Instant
    """The tick of the last cycle."""
    ended_at: Instant
    interrupted: bool


def planned_cycles(duration: Duration, period: Duration) -> int:
    """The cycles of a run; one that has begun is whole."""
    return -(-duration // period)


class Loop:
    """Runs axes on one bus."""

    def __init__(
        self,
        network: Master,
        clock: Clock,
        axes: Sequence[Axis],
        pace: Pace,
        timing: LoopTiming,
        chore: Callable[[Instant], Instant] | None = None,
    ) -> None:
        """``pace``: starts the cycles. ``chore``: done at the end of a cycle, when the commands are out; it
        returns when it is due again, and must not wait."""
        self._network = network
        self._clock = clock
        self._now = clock.now
        self._axes = tuple(axes)
        self._pace = pace
        self._timing = timing
        self._chore = chore
        self._chore_at = Instant(0)
        self._started_at = self._due_at = Instant(0)
        self._planned = self._number = self._missed = 0

    def calibrate(self) -> None:
        """Learn the drives' clocks. Raises ``NoAnswer`` if an axis stays silent throughout."""
        answered = self._pace.calibrate(self._axes, self._timing.settle)
        for axis, came in zip(self._axes, answered, strict=True):
            if not came:
                raise NoAnswer(
                    f"{axis.parts.name}: no reading came in answer to any SYNC",
                    remedy="check that the drive is operational and that its TPDOs are synchronous",
                )

    def run(
        self,
        duration: Duration,
        should_stop: Callable[[], bool],
        on_start: Callable[[Instant], None],
        progress: Callable[[int], None],
    ) -> LoopOutcome:
        """Run the cycles of ``duration``; ``progress`` is given the number done so far, and may raise.

        Raises ``LimitExceeded`` when a safety limit is crossed; the caller brings the drives to rest.
        """
        self._planned = planned_cycles(duration, self._timing.period)
        progress_every = max(1, PROGRESS_EVERY // self._timing.period)
        self._started_at = self._due_at = self._pace.begin(self._axes)
        on_start(self._started_at)
        for axis in self._axes:
            axis.reset()
        interrupted = False
        self._number = self._missed = 0
        try:
            while self._number < self._planned:
                if should_stop():
                    interrupted = True
                    break
                self._serve(self._pace.next())
                if self._number % progress_every == 0:
                    progress(self._number)
            ended_at = self._now()
            self._drain(interrupted)
        finally:
            self._network.withdraw()  # a row is not to tell of a frame that may go out after it
            for axis in self._axes:
                axis.settle_all(BEYOND_ANY_HORIZON)
        return LoopOutcome(self._number, self._missed, self._started_at, self._due_at, ended_at, interrupted)

    def _serve(self, start: Start) -> None:
        self._due_at = start.due_at
        if start.served and start.woke_at is not None:
            self._cycle(start.due_at, start.woke_at)
        else:
            self._miss(start.due_at, start.woke_at)

    def _miss(self, due: Instant, woke_at: Instant | None) -> None:
        """A tick goes without SYNC. The drives are looked at all the same, once the ticks of a host that was
        away are accounted for."""
        self._number += 1
        self._missed += 1
        tick = Tick(self._number, due, woke_at, (due - self._started_at) / NS_PER_S)
        reasons = [axis.miss(tick) for axis in self._axes]
        for axis in self._axes:
            axis.collect(due)
            axis.settle(self._number)
        for reason in reasons:
            if reason is not None:
                raise LimitExceeded(reason, remedy="the drive is being brought to rest")
        if self._now() - due <= self._timing.period:
            for axis in self._axes:
                axis.parts.drive.check()

    def _cycle(self, due: Instant, woke_at: Instant) -> None:
        axes = self._axes
        probe = False
        for axis in axes:
            probe = probe or (self._pace.can_probe and axis.wants_probe)
        handed_at = self._pace.sync(self._number + 1, due, probe)
        for _ in range(ticks_passed(due, self._timing.period, handed_at)):
            self._miss(due, woke_at)
            if self._number == self._planned:
                return
            due, woke_at = Instant(due + self._timing.period), handed_at
        self._number, self._due_at = self._number + 1, due
        tick = Tick(self._number, due, woke_at, (due - self._started_at) / NS_PER_S)
        for axis in axes:
            if probe:
                axis.probed()
            axis.begin(tick)
        self._await_readings(tick)
        now = due
        for axis in axes:
            now = self._now()
            axis.decide(tick, now, self._apply_at(due, now))
        for axis in axes:
            axis.settle(self._number)
        if self._chore is not None and now >= self._chore_at:
            self._chore_at = self._chore(self._now())

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

    def _apply_at(self, due: Instant, now: Instant) -> Instant:
        timing = self._timing
        if timing.actuation is Actuation.ON_SYNC:
            return Instant(due + timing.period + timing.sync_latency)
        return Instant(now + timing.command_latency)

    def _drain(self, interrupted: bool) -> None:
        """Let the readings that are still on their way come in; not when the drives must stop at once."""
        if interrupted:
            return
        self._network.pump(Instant(self._now() + self._timing.settle))
        for axis in self._axes:
            axis.collect()
