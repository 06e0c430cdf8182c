"""Command supervision: who notices that a drive no longer hears its host, and the last resort to stop it.

commands cease to arrive    the drive, by the event timer of its RPDO (1400h:05), and stops by 6007h
they are not followed       the host, by the demand or torque that the drive tells, and stops it by SDO
the statusword ceases       the host, by the event timer of the TPDO
nothing stops the drive     the host withholds its heartbeat: 1016h and 6007h of the drive
"""

import math
from contextlib import suppress
from typing import Final, NamedTuple

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import RemoteObjects, SettingRefused
from servobench.drivers.canopen.pdo import PdoEntry, PdoPlan
from servobench.drivers.canopen.polls import ObjectPoll, Polled
from servobench.drivers.cia402.command_watch import (
    ACTUAL_MARGIN_RAW,
    ACTUAL_SHARE,
    DEMAND_MARGIN_RAW,
)
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_plans import TARGETS, features_of
from servobench.drivers.cia402.profile import Mode, State
from servobench.drivers.cia402.readings import ReadingAssembler
from servobench.drivers.cia402.velocity_mode import velocity_mode_ramp, velocity_mode_unit
from servobench.drivers.core.native import CommandWatch
from servobench.drivers.errors import BusDown, PeerFault, TransferAborted
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant

LATER: Final = 10
"""The host waits a tenth longer than a drive with a timer, which stops by itself and reports it."""
READS: Final = 4
"""Reads of a demand by SDO within the supervision time: two while the last followed command is recent, and
two when it is not."""
READ_EVERY_MIN: Final = Duration(10 * NS_PER_MS)
"""Two frames of at most 135 bits are then 3 % of 1 Mbit/s."""
VL_MARGIN_RAW: Final = 1
"""6042h and 6043h count in the same whole units: a demand is the set-point, or rounded to its neighbour."""
LEAST_SHARE: Final = 0.01
"""Share of the highest speed: a drive may treat a slower one as rest."""
_DEMANDS: Final[dict[int, PdoEntry]] = {
    Object.TARGET_TORQUE: PdoEntry(Object.TORQUE_DEMAND, 0, "h"),
    Object.VL_TARGET_VELOCITY: PdoEntry(Object.VL_VELOCITY_DEMAND, 0, "h"),
    Object.TARGET_VELOCITY: PdoEntry(Object.VELOCITY_DEMAND_VALUE, 0, "i"),
    Object.TARGET_POSITION: PdoEntry(Object.POSITION_DEMAND_VALUE, 0, "i"),
    Object.INTERPOLATION_DATA_RECORD: PdoEntry(Object.POSITION_DEMAND_VALUE, 0, "i"),
}
"""The demand that corresponds to each set-point object, CiA 402-2."""
_EVENT_TIMER: Final = 5
"""Sub-index of a PDO's communication parameter: the time-out of an RPDO, ms (CiA 301 7.5.2.35)."""


class Release(NamedTuple):
    """State in which a drive was left."""

    at_rest: bool
    state: State | None
    evidence: str = ""
    """Problems on the way; empty if there were none."""
    rested_at: Instant | None = None
    """Since when it was at rest; None if it was not, or never moved."""
    unwatched: str = ""
    """In words, if its 1016h held another value at the end than was written."""


class CommandSupervision:
    """Supervision of one drive while a run sends it a command in every cycle."""

    def __init__(self, objects: RemoteObjects) -> None:
        self._objects = objects
        self._settings: DriveSettings | None = None
        self._plan = PdoPlan((), ())
        self._assembler: ReadingAssembler | None = None
        self._timed: int | None = None
        self._watch: CommandWatch | None = None
        self._offset = 0
        self._poll: ObjectPoll | None = None
        self._polled: Polled | None = None

    def configure(self, settings: DriveSettings, plan: PdoPlan, assembler: ReadingAssembler) -> None:
        """Take in the drive's set-up; supervision has not begun."""
        self._settings, self._plan, self._assembler = settings, plan, assembler
        self._timed = self._watch = None

    def begin(self, mode: Mode, *, own_timer: bool = True) -> str:
        """Have the drive and the host supervise the commands of ``mode`` from now on.

        ``own_timer``: the drive by the timer of its RPDO; False: the host alone, whose commands may cease.
        Returns who does, and when the drive begins to stop and is at rest; empty without
        ``command_timeout_ms``.
        """
        settings = self._settings
        if settings is None or settings.command_timeout_ms is None:
            return ""
        timeout_ms = settings.command_timeout_ms
        index = self._timer_of(mode) if own_timer else None
        timed = index is not None and self._set_timer(index, timeout_ms)
        cycles = max(2, timeout_ms * NS_PER_MS // settings.sync_period_ns)
        cycles += max(2, cycles // LATER) if timed else 0
        demand = self._look_at(mode, cycles, settings.sync_period_ns)
        host = f"the host by {demand}, after {cycles} cycles"
        if timed:
            drive = f"the drive itself ({index:04X}h:05), after {timeout_ms} ms{_rest_text(settings)}"
            return f"{drive}; {host}" if demand else f"{drive}; what it follows is not compared"
        if not demand:
            drive = "the drive does not supervise its RPDO (1400h:05), nor report" if own_timer else (
                "the drive does not tell"
            )  # fmt: skip
            return f"nobody: {drive} what to compare with"
        return f"{host} ({timeout_ms} ms){_rest_text(settings)}"

    def _look_at(self, mode: Mode, cycles: int, period_ns: int) -> str:
        """Compare commands with the drive's demand or torque; return which in words, empty if there is
        none."""
        objects, plan, target = self._objects, self._plan, TARGETS.get(mode)
        self._end_poll()
        if target is None or plan.rpdo_with(target.index, target.sub) is None:
            return ""
        torque = target.index == Object.TARGET_TORQUE
        sloped = not torque or mode is Mode.PROFILE_TORQUE  # the drive goes to a command by a ramp
        if torque:
            self._offset = objects.read_if_there(Object.TORQUE_OFFSET, 0, "h") or 0
            if features_of(plan).demand:
                self._watch_torque(CommandWatch(cycles, DEMAND_MARGIN_RAW, equal=not sloped))
                return "6074h"
        demand = _DEMANDS.get(target.index)
        if demand is not None and objects.read_if_there(demand.index, 0, demand.code) is not None:
            self._watch = self._watch_of(demand, cycles, period_ns, sloped=sloped)
            every = Duration(max(-(-READ_EVERY_MIN // period_ns), -(-cycles // READS)) * period_ns)
            self._polled = Polled(objects.node_id, demand.index, 0, every, self._demand_read)
            return f"{demand.index:04X}h, read by SDO every {every / NS_PER_MS:.3g} ms"
        if sloped or plan.tpdo_with(Object.TORQUE_ACTUAL_VALUE) is None:
            return ""
        self._watch_torque(CommandWatch(cycles, ACTUAL_MARGIN_RAW, share=ACTUAL_SHARE))
        return "6077h"

    def _watch_of(self, demand: PdoEntry, cycles: int, period_ns: int, *, sloped: bool) -> CommandWatch:
        """Return the watch for a demand that is read: a torque, speed or position."""
        objects, settings, assembler = self._objects, self._settings, self._assembler
        assert settings is not None
        assert assembler is not None
        margin, unit, unit_cycles = DEMAND_MARGIN_RAW, 0.0, 0
        if demand.index == Object.VL_VELOCITY_DEMAND:
            margin, unit = VL_MARGIN_RAW, abs(velocity_mode_unit(objects))
            ramps = (Object.VL_VELOCITY_ACCELERATION, Object.VL_VELOCITY_DECELERATION)
            slowest = min(
                filter(None, (velocity_mode_ramp(objects, each) for each in ramps)), default=math.inf
            )
            unit_cycles = math.ceil(NS_PER_S * unit / slowest / period_ns)
        elif demand.index == Object.VELOCITY_DEMAND_VALUE:
            unit = abs(assembler.scaling.velocity_rad_s)
        fastest = settings.speed_max_rad_s
        least = math.ceil(LEAST_SHARE * fastest / unit) if unit and fastest else None
        return CommandWatch(cycles, margin, equal=not sloped, least_raw=least, unit_cycles=unit_cycles)

    def _demand_read(self, data: bytes, at: Instant) -> None:  # noqa: ARG002
        watch, assembler = self._watch, self._assembler
        if watch is not None and assembler is not None:
            assembler.tell_watch(watch, int.from_bytes(data[:4], "little", signed=True))

    def sent(self, raw: int) -> None:
        """Note that a command was handed to the bus."""
        if self._watch is not None:
            self._watch.sent(raw + self._offset)
        if self._polled is not None and self._poll is None:
            # Behind a command, and whole cycles later again: no SYNC waits for the frames of a read.
            self._poll = self._objects.network.poll(self._polled)

    @property
    def follows(self) -> bool:
        """True while the drive follows its commands, as far as the host sees."""
        return self._watch is None or self._watch.follows

    @property
    def active(self) -> bool:
        """True while the drive or the host supervises the commands."""
        return self._timed is not None or self._watch is not None

    def end(self) -> None:
        """End the supervision before the commands cease. A drive that ignores this stops by its timer, as
        intended."""
        self._watch_torque(None)
        self._end_poll()
        if self._timed is not None:
            with suppress(PeerFault):
                self._objects.write(self._timed, _EVENT_TIMER, "H", 0)
            self._timed = None

    def _timer_of(self, mode: Mode) -> int | None:
        """Return the communication parameter of the RPDO with the set-point, if it has an event timer."""
        target = TARGETS.get(mode)
        rpdo = None if target is None else self._plan.rpdo_with(target.index, target.sub)
        if rpdo is None or self._objects.read_if_there(rpdo.communication_index, _EVENT_TIMER, "H") is None:
            return None
        return rpdo.communication_index

    def _set_timer(self, index: int, timeout_ms: int) -> bool:
        try:
            self._objects.write_verified(index, _EVENT_TIMER, "H", timeout_ms)
        except (TransferAborted, SettingRefused):
            return False
        self._timed = index
        return True

    def _end_poll(self) -> None:
        if self._poll is not None:
            self._objects.network.polls.end(self._poll)
        self._poll = self._polled = None

    def _watch_torque(self, watch: CommandWatch | None) -> None:
        self._watch = watch
        if self._assembler is not None:
            self._assembler.watch = watch


def end_heartbeat(network: CanopenNetwork, *, watched: bool) -> str:
    """Stop the heartbeat: the last resort for a drive that nothing else stops; return what was done, in
    words.

    ``watched``: the drive watches the host, by 1016h or by life guarding.
    """
    if not watched:
        return "it does not watch the host's heartbeat: stop it by hand"
    with suppress(BusDown):
        network.fall_silent()
    return f"the host's heartbeat ended: each drive on {network.link.name} that watches it (1016h) stops"


def _rest_text(settings: DriveSettings) -> str:
    """Say how long a stop takes from the highest speed allowed by the settings."""
    speed, deceleration = settings.speed_max_rad_s, settings.quick_stop_deceleration_rad_s2
    if speed is None or deceleration is None:
        return ", then by the drive's own quick stop"
    return f", and at rest within {1e3 * speed / deceleration:.0f} ms from then"
