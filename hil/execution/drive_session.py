"""The life of drives in the hands of a host: guarded, cycled in a loop, and let go at rest on every way out.

A run, a measurement and a commissioning go through it:

    configure -> cycle (the guard is armed) -> calibrate, enable, loop -> let_go (at rest, disabled) -> end

What lies between differs: which objects are written and read back, what a controller does, who is told.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from typing import Final

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.supervision import Release
from servobench.drivers.exchange import Master
from servobench.drivers.timebase import Instant, duration_s
from servobench.hil.configuration.config import Foreign, Guard
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.execution.bus_guard import NO_BENCH, BusGuard
from servobench.hil.execution.drives import stop_all
from servobench.hil.execution.world import World
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.loop import Loop, LoopTiming
from servobench.hil.loop.pace import Pace
from servobench.hil.loop.syncs import SyncLog

ENABLE_LIMIT_S: Final = 2.0
"""A drive that charges its DC link or releases a brake takes a second or so."""


def _nothing() -> None:
    """Do nothing."""


class DriveSession:
    """Drives, and the guard of their bus."""

    def __init__(
        self,
        world: World,
        networks: Mapping[str | None, CanopenNetwork],
        drives: Sequence[ServoDrive],
        rules: Guard,
        tell: Callable[[Instant, str, str], None],
        *,
        own_sync: bool = True,
        repeated: Collection[Foreign] = (),
    ) -> None:
        """See :class:`BusGuard`."""
        self.guard = BusGuard(
            networks, drives, rules, tell, world.error_frames, own_sync=own_sync, repeated=repeated
        )
        self._world = world

    def enable(self, drive: ServoDrive, limit_s: float = ENABLE_LIMIT_S) -> None:
        """Enable a configured drive. Raises PeerFault."""
        drive.enable(drive.network.deadline_after(duration_s(limit_s)))

    def cycle(
        self,
        master: Master,
        axes: Sequence[Axis],
        pace: Pace,
        timing: LoopTiming,
        syncs: Mapping[str | None, SyncLog],
        *,
        delays_of: Sequence[Axis] = (),
        bench: Mapping[str, DriveConfig] = NO_BENCH,
        chore: Callable[[Instant], None] | None = None,
    ) -> Loop:
        """Arm the guard, and return the loop that it attends.

        ``delays_of``, ``bench``: see :meth:`BusGuard.arm`; ``chore``: another for each cycle.
        """
        self.guard.arm(syncs, timing.period, delays_of, bench)
        return Loop(master, self._world.clock, axes, pace, timing, self.guard.attending(chore))

    def let_go(
        self,
        drives: Sequence[ServoDrive],
        released: Callable[[ServoDrive, Release], None],
        *,
        stopped: Sequence[ServoDrive] | None = None,
        unload: Callable[[], None] = _nothing,
    ) -> None:
        """Bring the drives to rest, disable them and let them go: every way out leads through here.

        Injected faults end, and the guard ends nothing any more. All drives are told to stop before the first
        is let go; then ``unload`` takes their loads away. ``stopped``: those to stop, by default all; one
        that was never enabled has nothing to stop. Whatever ``unload`` and ``released`` raise, each drive
        is let go, and the last of their errors is passed on.
        """
        self.guard.calm()
        self._world.faults.stop()
        with ExitStack() as every:
            for drive in reversed(drives):
                every.callback(lambda each: released(each, each.release()), drive)
            stop_all(drives if stopped is None else stopped)
            unload()

    def end(self, zero: Instant | None = None) -> tuple[str, ...]:
        """Return the frames of others, as far as they disturbed; see :meth:`BusGuard.end`."""
        return self.guard.end(self._world.clock.now(), zero)
