"""Watches the bus of a run for frames that the bench did not send, did not request, or does not expect.

    COB-IDs of the bench itself     NMT, SYNC, its heartbeat, SDO requests and RPDOs to its drives
    more answers than questions     TPDOs beyond the SYNCs, SDO answers beyond the requests
    nodes that start                boot-up messages
    errors                          EMCYs of any node, a sudden rise of error frames

It does not look at each frame. The guard listens on identifiers with little or no expected traffic, and
compares existing counts ten times a second. The first occurrence of each kind is an event with the instant of
its frame; further ones are counted, for the summary. The first two kinds disturb a run, unless
``[guard] allow`` names them.
"""

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Final, NamedTuple

from servobench.drivers.canopen import cob_ids
from servobench.drivers.canopen.cob_ids import frame_name
from servobench.drivers.canopen.frame_pump import Handler, one_after_another
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt import Emergency, parse_emergency
from servobench.drivers.canopen.nmt_states import NODE_ID_MAX
from servobench.drivers.canopen.objects301 import Cia301, object_name
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.configuration.config import Foreign, Guard, Rule
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.execution.stream_watch import QUIET_SYNCS, DelaysKnown, SyncedStream, TimedStream
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.syncs import REMEMBERED, SyncLog

LOOK_EVERY: Final = Duration(100 * NS_PER_MS)
"""Far below a second, in which a bench can still be stopped in time; far above a cycle, which it must not
slow down."""
LOOK_EVERY_SYNCS: Final = REMEMBERED // 2
"""Interval in SYNCs, if longer: beyond it the SYNCs needed for comparison are forgotten."""
ERRORS_A_SECOND_MAX: Final = 16
"""A transmitter with this many consecutive errors is error passive (8 are counted for each, 128 is the limit:
ISO 11898-1, 12.1.4); a sound bus has less than one an hour."""
_BOOT_UP: Final = b"\x00"
_SDO_WRITES: Final = (1, 6)
"""Client command specifiers of initiate download, also of blocks, CiA 301 7.2.4.3.3 and 7.2.4.3.9."""
_SDO_READS: Final = (2, 3, 5)
"""The same of uploads, their segments and blocks, CiA 301 7.2.4.3.5, 7.2.4.3.6 and 7.2.4.3.12."""
_SDO_SEGMENT, _SDO_ABORT = 3, 4
_NMT_BYTES: Final = 2
_MESSAGE_BYTES: Final = 8
"""Length of every SDO request, CiA 301 7.2.4.3."""
OBJECTS_TOLD: Final = 16
"""Written objects reported one by one: more are arbitrary writes."""


NO_BENCH: Final[Mapping[str, DriveConfig]] = {}


class ForeignTraffic(PeerFault):
    """Another node does something on the bus that ``[guard]`` of the bench forbids."""


class GuardedSegment(NamedTuple):
    """The bench's part of one segment."""

    network: CanopenNetwork
    drives: tuple[ServoDrive, ...]


class _WatchedTpdo(NamedTuple):
    title: str
    stream: SyncedStream


class BusGuard:
    """The guard of one run, on all its segments, from now on.

    Call :meth:`arm` when the drives are configured, and again when they or the SYNCs change; :meth:`calm`
    before they are released, :meth:`end` at last. Where a rule says ``stop``, whatever lets time pass raises
    ForeignTraffic, once.
    """

    def __init__(
        self,
        networks: Mapping[str | None, CanopenNetwork],
        drives: Sequence[ServoDrive],
        rules: Guard,
        tell: Callable[[Instant, str, str], None],
        error_frames: Callable[[], int],
        *,
        own_sync: bool = True,
        repeated: Collection[Foreign] = (),
    ) -> None:
        """``networks``: by the name of their segment. ``tell``: takes instant, level and text of an event.
        ``error_frames``: on all segments so far. ``own_sync``: the bench alone makes SYNCs. ``repeated``:
        frames repeated by injected faults, not by another node."""
        self.counts: dict[str, int] = {}
        """Count of each kind."""
        self._disturbances: dict[str, tuple[Instant, str]] = {}
        """First occurrence of each disturbance, and its frame in words."""
        self._made_at = next(iter(networks.values())).clock.now()
        self._objects: set[tuple[int, int]] = set()
        """Objects written by others."""
        self._segments = {
            name: GuardedSegment(network, tuple(drive for drive in drives if drive.network is network))
            for name, network in networks.items()
        }
        self._rules = rules
        self._allowed = {*rules.allow, *repeated}
        self._tell = tell
        self._error_frames = error_frames
        self._ends_run = True
        self._tpdos: list[_WatchedTpdo] = []
        self._look_every = LOOK_EVERY
        self._errors: deque[int] = deque([error_frames()], maxlen=NS_PER_S // LOOK_EVERY + 1)
        self._look_at = Instant(0)
        self._on_emergency = {
            name: self._emergency_listener(segment) for name, segment in self._segments.items()
        }
        for name, segment in self._segments.items():
            segment.network.on_emergency(self._on_emergency[name])
            segment.network.on_surplus_answer = self._on_surplus_answer
            self._watch_own_identifiers(segment, own_sync)

    def arm(
        self,
        syncs: Mapping[str | None, SyncLog],
        period: Duration,
        axes: Sequence[Axis] = (),
        bench: Mapping[str, DriveConfig] = NO_BENCH,
    ) -> None:
        """Arm the guard: the drives are configured, and no node should start any more.

        ``syncs``: by the name of their segment, readings are compared with them; ``period``: theirs.
        ``axes``: source of the readings' delays; without it no single surplus reading is identified.
        ``bench``: data of the drives, by name: periods of their heartbeats.
        """
        self._ends_run = True
        self._look_every = Duration(min(LOOK_EVERY, LOOK_EVERY_SYNCS * period))
        delays = {axis.parts.name: partial(_delays_of, axis, period) for axis in axes}
        self._tpdos = []
        for name, segment in self._segments.items():
            self._watch_nodes(name, segment)
            for drive in segment.drives:
                self._watch_commands(segment, drive)
                self._watch_timers(segment, drive, bench.get(drive.name))
                for pdo in drive.plan.tpdos if drive.plan is not None and name in syncs else ():
                    if pdo.synchronous:
                        title = f"{pdo.name} of node {drive.node_id} ({pdo.cob_id:03X}h)"
                        known = delays.get(drive.name, _unknown)
                        frames = drive.assembler
                        frames.keep_frames(pdo.cob_id)
                        stream = SyncedStream(pdo, frames.take_frames, syncs[name], period, known)
                        self._tpdos.append(_WatchedTpdo(title, stream))

    def attend(self, now: Instant) -> Instant:
        """Check, ten times a second; return when to be called next, at the latest."""
        if now < self._look_at:
            return self._look_at
        if now - self._look_at > NS_PER_S:
            self._forget_errors()
        self._look_at = Instant(now + self._look_every)
        self._look_at_tpdos(now)
        errors = self._error_frames()
        rise = errors - self._errors[0]
        self._errors.append(errors)
        if rise >= ERRORS_A_SECOND_MAX:
            self._forget_errors()
            what = f"{ERRORS_A_SECOND_MAX} and more error frames within a second"
            self._note(self._rules.on_bus_errors, what, now, f"{rise} now, {errors} in all")
        return self._look_at

    def _look_at_tpdos(self, now: Instant, *, at_end: bool = False) -> None:
        for tpdo in self._tpdos:
            what = f"{tpdo.title}: more than the SYNCs ask for"
            extras, more = tpdo.stream.look(at_end=at_end)
            for extra in extras:
                self._foreign("tpdo", what, extra.at, f"data {_hex(extra.data)}")
            if more:
                self._foreign("tpdo", what, now, f"{more} since the last look", more)

    def attending(self, chore: Callable[[Instant], None] | None) -> Callable[[Instant], Instant]:
        """Combine :meth:`attend` with another chore of the loop, one of each cycle."""
        if chore is None:
            return self.attend

        def both(now: Instant) -> Instant:
            chore(now)
            return min(now, self.attend(now))

        return both

    def calm(self) -> None:
        """Report only, without stopping anything: the run is over."""
        self._ends_run = False

    def end(self, now: Instant, zero: Instant | None = None) -> tuple[str, ...]:
        """Report repeated observations, and return those not named by ``[guard] allow``: the first frame of
        each kind in words, when it came, and the count.

        ``zero``: of the run; None: the guard's own beginning is.
        """
        self._look_at_tpdos(now, at_end=True)
        since = self._made_at if zero is None else zero
        found = []
        for what, count in self.counts.items():
            times = ""
            if count > 1:
                self._tell(now, "WARN", f"{what}: {count} times in all")
                times = f", {count} times"
            if what in self._disturbances:
                at, detail = self._disturbances[what]
                found.append(f"{what}: {detail}, at {(at - since) / NS_PER_S:.3f} s{times}")
        return tuple(found)

    # ---- inside ---------------------------------------------------------------------------------------

    def _forget_errors(self) -> None:
        self._errors.clear()
        self._errors.append(self._error_frames())

    def _foreign(self, kind: Foreign, what: str, at: Instant, detail: str, count: int = 1) -> None:
        """Note a foreign frame, and its consequence for the run."""
        if kind in self._allowed:
            self._count(what, at, f"{what}: {detail}", count, "INFO")
            return
        self._disturbances.setdefault(what, (at, detail))
        self._note(self._rules.on_foreign, what, at, detail, count)

    def _note(self, rule: Rule, what: str, at: Instant, detail: str, count: int = 1) -> None:
        self._count(what, at, f"{what}: {detail}", count)
        if rule == "stop" and self._ends_run:
            self._ends_run = False
            raise ForeignTraffic(what, detail, "find who sends it (hil scan), or set the rule in [guard]")

    def _count(self, what: str, at: Instant, text: str, count: int, level: str = "WARN") -> None:
        before = self.counts.get(what, 0)
        self.counts[what] = before + count
        if not before:
            self._tell(at, level, text)

    def _watch_own_identifiers(self, segment: GuardedSegment, own_sync: bool) -> None:
        pump, beat = segment.network.frame_pump, cob_ids.ERROR_CONTROL + segment.network.node_id
        pump.overhear(cob_ids.NMT, self._nmt_watcher({drive.node_id for drive in segment.drives}))
        pump.overhear(beat, self._foreign_watcher("heartbeat", beat))
        if own_sync:
            pump.overhear(cob_ids.SYNC, self._foreign_watcher("sync", cob_ids.SYNC))
        for drive in segment.drives:
            pump.overhear(cob_ids.SDO_REQUEST + drive.node_id, self._request_watcher(drive.node_id))
            self._watch_commands(segment, drive)

    def _watch_commands(self, segment: GuardedSegment, drive: ServoDrive) -> None:
        """Watch a drive's RPDOs: the predefined ones until it is configured."""
        plan = drive.plan
        own = [pdo.cob_id for pdo in plan.rpdos] if plan else [base + drive.node_id for base in cob_ids.RPDOS]
        for can_id in own:
            watch = self._foreign_watcher("rpdo", can_id)
            segment.network.frame_pump.overhear(can_id, _unless_others(drive, can_id, watch))

    def _watch_nodes(self, name: str | None, segment: GuardedSegment) -> None:
        pump, own = segment.network.frame_pump, {drive.node_id for drive in segment.drives}
        listener = self._on_emergency[name]
        for node_id in range(1, NODE_ID_MAX + 1):
            if node_id != segment.network.node_id:
                pump.overhear(cob_ids.ERROR_CONTROL + node_id, self._boot_watcher(node_id))
            if node_id not in own:
                pump.overhear(cob_ids.EMERGENCY + node_id, _emergency_watcher(node_id, listener))

    def _watch_timers(self, segment: GuardedSegment, drive: ServoDrive, said: DriveConfig | None) -> None:
        """Watch heartbeats, unless the drive is guarded, and TPDOs that come by a timer while nothing
        changes."""
        node_id, pump = drive.node_id, segment.network.frame_pump
        if said is not None and not segment.network.status(node_id).guarded:
            can_id = cob_ids.ERROR_CONTROL + node_id
            title = f"heartbeat of node {node_id} ({can_id:03X}h)"
            stream = TimedStream(Duration(said.heartbeat_ms * NS_PER_MS), repeats=True)
            boots, beats = self._boot_watcher(node_id), self._timer_watcher("heartbeat", title, stream)
            pump.overhear(can_id, one_after_another(boots, beats))
        for pdo in drive.plan.tpdos if drive.plan is not None else ():
            if pdo.event_timer_ms and not pdo.synchronous:
                period = Duration(pdo.event_timer_ms * NS_PER_MS)
                title = f"{pdo.name} of node {drive.node_id} ({pdo.cob_id:03X}h)"
                watch = self._timer_watcher("tpdo", title, TimedStream(period, repeats=False))
                pump.overhear(pdo.cob_id, watch)

    def _timer_watcher(self, kind: Foreign, title: str, stream: TimedStream) -> Handler:
        what = f"{title}: more than its timer asks for"

        def watch(data: bytes, at: Instant) -> None:
            for extra in stream.take(data, at):
                self._foreign(kind, what, extra.at, f"data {_hex(extra.data)}")

        return watch

    def _foreign_watcher(self, kind: Foreign, can_id: int) -> Handler:
        what = f"{frame_name(can_id)} ({can_id:03X}h) that the bench did not send"

        def watch(data: bytes, at: Instant) -> None:
            self._foreign(kind, what, at, f"data {_hex(data)}")

        return watch

    def _nmt_watcher(self, nodes: set[int]) -> Handler:
        """Return a handler for commands to all nodes or to one of ``nodes``: others may have their own
        master."""
        watch = self._foreign_watcher("nmt", cob_ids.NMT)

        def watch_own(data: bytes, at: Instant) -> None:
            if len(data) != _NMT_BYTES or not data[1] or data[1] in nodes:
                watch(data, at)

        return watch_own

    def _request_watcher(self, node_id: int) -> Handler:
        where = f"node {node_id} ({cob_ids.SDO_REQUEST + node_id:03X}h)"
        last = b""  # the object of the read before: to break it off is a part of it

        def watch(data: bytes, at: Instant) -> None:
            nonlocal last
            command = data[0] >> 5 if len(data) == _MESSAGE_BYTES else -1
            index = int.from_bytes(data[1:3], "little")
            kind: Foreign = "sdo_write"
            what = f"SDO request to {where} that the bench did not send"
            if command in _SDO_READS or (command == _SDO_ABORT and data[1:4] == last):
                last = last if command == _SDO_SEGMENT else data[1:4]
                kind, what = "sdo_read", f"SDO read from {where} that the bench did not send"
            elif command in _SDO_WRITES and index == Cia301.CONSUMER_HEARTBEAT_TIME:
                what = f"1016h of node {node_id} changed by another: it may no longer watch the bench"
            elif command in _SDO_WRITES and self._is_told(index, data[3]):
                what = f"SDO write of {object_name(index, data[3])} to {where} that the bench did not send"
            self._foreign(kind, what, at, f"data {_hex(data)}")

        return watch

    def _is_told(self, index: int, sub: int) -> bool:
        """Return True if a write to an object is reported by its name."""
        if len(self._objects) < OBJECTS_TOLD:
            self._objects.add((index, sub))
        return (index, sub) in self._objects

    def _boot_watcher(self, node_id: int) -> Handler:
        def watch(data: bytes, at: Instant) -> None:
            if data == _BOOT_UP:
                self._note(self._rules.on_boot, f"node {node_id} started", at, "a boot-up message")

        return watch

    def _on_surplus_answer(self, node_id: int, data: bytes, at: Instant) -> None:
        what = f"node {node_id} sends more answers than requested: two nodes are likely to have its id"
        shown = f"an SDO answer too many ({cob_ids.SDO_ANSWER + node_id:03X}h), data {_hex(data)}"
        self._foreign("sdo_answer", what, at, shown)

    def _emergency_listener(self, segment: GuardedSegment) -> Callable[[Emergency], None]:
        drives = {drive.node_id: drive for drive in segment.drives}

        def listen(emergency: Emergency) -> None:
            drive = drives.get(emergency.node_id)
            who = f"node {emergency.node_id}" if drive is None else drive.name
            text = emergency.told() if drive is None else emergency.told(*drive.control.make)
            self._count(f"{who}: EMCY {emergency.code:04X}h", emergency.at, f"{who}: {text}", 1)

        return listen


def _hex(data: bytes) -> str:
    return data.hex(" ").upper() or "none"


def _unless_others(drive: ServoDrive, can_id: int, watch: Handler) -> Handler:
    """Return ``watch``, active while ``can_id`` is one of the drive's RPDOs, or those are unknown."""

    def watch_own(data: bytes, at: Instant) -> None:
        if drive.plan is None or any(pdo.cob_id == can_id for pdo in drive.plan.rpdos):
            watch(data, at)

    return watch_own


def _unknown() -> DelaysKnown:
    return DelaysKnown.UNKNOWN


def _delays_of(axis: Axis, period: Duration) -> DelaysKnown:
    stamped = axis.by_stamp.clock.ready
    known = not axis.by_stamp.question.open if stamped else axis.by_order.settled
    if not known or axis.meter.typical_delay >= period:
        return DelaysKnown.UNKNOWN
    enough = stamped and axis.by_stamp.health.placed >= QUIET_SYNCS
    return DelaysKnown.ALL_SHORT if enough and axis.by_stamp.longest_delay < period else DelaysKnown.SHORT


def _emergency_watcher(node_id: int, listener: Callable[[Emergency], None]) -> Handler:
    def watch(data: bytes, at: Instant) -> None:
        emergency = parse_emergency(node_id, data, at)
        if emergency is not None:
            listener(emergency)

    return watch
