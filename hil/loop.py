"""The control loop: one thread, one SYNC a cycle, all axes.

    tick         due                  decide_at                        next due
    host          | SYNC ....... decide, RPDO ......... rest ............. |
    drive            | sample, TPDOs       | set-point acts

Time passes only inside ``network.rest``, ``network.pump`` and ``network.pump_one``, which wait in the
bus's ``recv``; on hardware that blocks, in simulation it steps the event heap. The
loop cannot tell which.

Every tick of the grid is a cycle and has a fate. One for which the host comes more than half a period too
late, or whose SYNC would be handed over while the last one has not come to the bus, goes without SYNC.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from drivers.errors import LimitExceeded, NoAnswer
from drivers.exchange import Master
from drivers.timebase import NS_PER_S, Clock, Duration, Instant
from hil.axis import Axis, Tick
from hil.syncs import SyncLog
from hil.ticker import ticks_missed

CALIBRATION_SYNCS: Final = 16
"""Enough for a first rate of the drive's clock to some 20 ppm, at stamps of 1 us."""
PROGRESS_EVERY_CYCLES: Final = 50
BEYOND_ANY_HORIZON: Final = 1 << 30


class Actuation(Enum):
    """When a drive applies a set-point."""

    ON_ARRIVAL = "on_arrival"
    ON_SYNC = "on_sync"


class SyncSource(Enum):
    """Who makes the SYNC."""

    OWN = "own"
    """This process, at each tick."""
    KERNEL = "kernel"
    """The bus's cyclic sender, e.g. SocketCAN's broadcast manager, on behalf of this process."""
    FOREIGN = "foreign"
    """A drive or another master."""


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
    """Planned cycles that have a fate."""
    cycles_missed: int
    """Those without SYNC."""
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
        syncs: Sequence[SyncLog],
        timing: LoopTiming,
        chore: Callable[[Instant], None] | None = None,
        stall: Callable[[Instant], Duration] | None = None,
    ) -> None:
        """``syncs``: of each segment. ``chore``: done at the end of each cycle, when the commands are out; it
        must not wait. ``stall``: for how long the host, which is to act now, is kept from it."""
        self._network = network
        self._clock = clock
        self._now = clock.now
        self._axes = tuple(axes)
        self._syncs = tuple(syncs)
        self._timing = timing
        self._chore = chore
        self._stall = stall
        self._started_at = Instant(0)
        self._number = 0
        self._missed = 0

    def calibrate(self) -> None:
        """Learn the drives' clocks from SYNCs so far apart that each reading answers the last one.

        Raises ``NoAnswer`` if an axis stays silent throughout.
        """
        answered = [False] * len(self._axes)
        for _ in range(CALIBRATION_SYNCS):
            sent_at = self._send_sync(0)
            self._network.pump(Instant(sent_at + self._timing.settle))
            for number, axis in enumerate(self._axes):
                answered[number] |= axis.calibrate()
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
        period = self._timing.period
        planned = -(-duration // period)
        due = Instant(self._now() + period)
        self._started_at = due
        on_start(due)
        interrupted = False
        self._number = self._missed = 0
        try:
            while self._number < planned:
                if should_stop():
                    interrupted = True
                    break
                due = self._serve(due, planned)
                if self._number % PROGRESS_EVERY_CYCLES == 0:
                    progress(self._number)
            ended_at = self._now()
            self._drain(interrupted)
        finally:
            for axis in self._axes:
                axis.settle_all(BEYOND_ANY_HORIZON)
        return LoopOutcome(self._number, self._missed, self._started_at, ended_at, interrupted)

    def _serve(self, due: Instant, planned: int) -> Instant:
        """Wait for the tick at ``due`` and serve it, or the first after it that can be; the next tick."""
        period = self._timing.period
        self._network.rest(due)
        woke_at = self._wake()
        missed = ticks_missed(due, period, woke_at)
        if missed:
            for _ in range(min(missed, planned - self._number)):
                self._miss(due, None)
                due = Instant(due + period)
            if self._number >= planned or due > woke_at:
                # The next tick is still to come.
                return due
        if self._may_hand_over(due):
            self._cycle(due, woke_at)
        else:
            self._miss(due, woke_at)
        return Instant(due + period)

    def _wake(self) -> Instant:
        """The host's instant, after what keeps it."""
        now = self._now()
        if self._stall is not None:
            stalled = self._stall(now)
            if stalled > 0:
                self._clock.sleep_until(Instant(now + stalled))
                now = self._now()
        return now

    def _may_hand_over(self, due: Instant) -> bool:
        """Whether the last SYNC is out, and half a period ago; waits for that, up to half a period."""
        half = self._timing.period // 2
        now = self._now()
        earliest = now
        for syncs in self._syncs:
            if not syncs.may_hand_over(now):
                return False
            earliest = max(earliest, Instant(syncs.last_on_bus + half))
        if earliest > due + half:
            return False
        if earliest > now:
            self._network.pump(earliest)
        return True

    def _send_sync(self, sequence: int) -> Instant:
        at = self._network.send_sync()
        for syncs in self._syncs:
            syncs.handed(sequence, at)
        return at

    def _miss(self, due: Instant, woke_at: Instant | None) -> None:
        """A tick goes without SYNC."""
        self._number += 1
        self._missed += 1
        tick = Tick(self._number, due, woke_at, (due - self._started_at) / NS_PER_S)
        reasons = [axis.miss(tick) for axis in self._axes]
        for axis in self._axes:
            axis.settle(self._number)
        for reason in reasons:
            if reason is not None:
                raise LimitExceeded(reason, remedy="the drive is being brought to rest")

    def _cycle(self, due: Instant, woke_at: Instant) -> None:
        axes = self._axes
        self._number += 1
        probe = False
        for axis in axes:
            probe = probe or axis.wants_probe
        if probe:
            self._network.pump(Instant(due + self._timing.period // 4))
        self._send_sync(self._number)
        tick = Tick(self._number, due, woke_at, (due - self._started_at) / NS_PER_S)
        for axis in axes:
            if probe:
                axis.probed()
            axis.begin(tick)
        self._await_readings(tick)
        for axis in axes:
            axis.decide(tick, self._apply_at(due))
        for axis in axes:
            axis.settle(self._number)
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
