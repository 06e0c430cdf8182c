"""A device that things happen to: it stands between a host and a simulated device.

    host -- receive, wake -->  FaultyDevice  -- receive, wake, bus_off ... -->  device
         <-- frames -- lost while it is silent, held while it is slow --

With fates it is a gateway too: frames in and out of the device are lost or held as those say, which no
echo at the sender tells. It works on any bus, for it only lets through or keeps back what passes. A device
that nothing ever befalls is not wrapped. A restart of the clock's drift at power-on is the device's own
affair.
"""

from collections.abc import Callable, Sequence
from enum import IntEnum
from heapq import heappop, heappush
from typing import TYPE_CHECKING, cast

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.objects301 import is_mapping
from servobench.drivers.timebase import NEVER, Instant
from servobench.drivers.wire.frame_port import EXTENDED_FLAG
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.bus.port import Port
from servobench.virtual_bus.core.native import HeldFrames
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.device.object_dictionary import Check
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.faults.fates import FateSource, Queue
from servobench.virtual_bus.faults.fault_log import KIND_CODES, FaultLog
from servobench.virtual_bus.faults.node_fault import DamagedDrive, NodeEvent
from servobench.virtual_bus.faults.node_faults import NodeSource, node_kind
from servobench.virtual_bus.frame import Frame

if TYPE_CHECKING:
    from servobench.virtual_bus.drive.servo import ServoApplication

_NOTHING: tuple[Frame, ...] = ()
_LATE, _BOOT = KIND_CODES["late"], KIND_CODES["boot"]


class _Stage(IntEnum):
    """Where a frame is held."""

    INSIDE = 0
    """In a slow drive."""
    LEAVING = 1
    """At its connection, on the way out."""
    COMING = 2
    """On the way in."""


class FaultyDevice:
    """``device`` with what ``source`` has for it; every strike goes into ``log``."""

    def __init__(
        self,
        device: CanopenDevice,
        source: NodeSource,
        log: FaultLog | None = None,
        fates: FateSource | None = None,
    ) -> None:
        """``fates``: what befalls frames at the device's connection to the bus."""
        self.device = device
        self.held = HeldFrames()
        self._fates = fates
        self.controller: Port | None = None
        """The device's, where the bus has error counters: it tells the device of bus-off by itself. None:
        bus-off is acted out here, by silence."""
        self._source = source
        self._log = log
        self._zero: Instant | None = None
        self._powered_at = self._now = Instant(0)
        self._silent_until = 0
        self._boots = 0
        device.follow_boot_time(self._boot_time)
        self._off = False
        self._out: list[Frame] = []
        """Frames that strikes make the device send."""
        self._timers: list[tuple[int, int, Callable[[Instant], None]]] = []
        self._queues = Queue(), Queue()
        """That of the PDOs and that of the SDO answers: each keeps its order."""
        self._frames: dict[int, int] = {}
        self._order = 0

    def start_faults(self, now: Instant) -> None:
        """Time zero of the plan is ``now``. Let the device ``wake`` afterwards."""
        self._zero = now
        if self._fates is not None:
            self._fates.start(now)

    def stop_faults(self) -> None:
        """Nothing new strikes; what has begun ends at its time, and a slow drive stays slow."""
        self._zero = None
        if self._fates is not None:
            self._fates.stop()

    @property
    def node_id(self) -> int:
        """Node-ID of the device inside."""
        return self.device.node_id

    @property
    def wake_at(self) -> Instant | None:
        """The earliest of the device's own wish and of what is planned for it."""
        due = NEVER if self._zero is None else self._strike_at()
        if self._timers and self._timers[0][0] < due:
            due = self._timers[0][0]
        if self.held:
            due = min(due, self.held.next_at())
        wish = self.device.wake_at
        if wish is not None and wish < due:
            return wish
        return None if due == NEVER else Instant(due)

    def start(self, now: Instant) -> Sequence[Frame]:
        """Power on."""
        self._powered_at = self._now = now
        for event in self._source.from_power_on:
            self._strike(event, now)
        return self._pass_on(self.device.start(now), now)

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """A frame on the bus; it meets its fate on the way in."""
        if self._fates is None:
            return self._hear(frame, now)
        out: list[Frame] = []
        self._meet_fate(_Stage.COMING, frame, now, out)
        return out

    def _hear(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """The device hears ``frame`` unless it is silent, off or booting."""
        if self._deaf(now):
            return _NOTHING
        self._now = now
        frames = self.device.receive(frame, now)
        return self._pass_on(frames, now) if frames else _NOTHING

    def wake(self, now: Instant) -> Sequence[Frame]:
        """Whatever is due: what strikes, what ends, what was held, and the device's own timers."""
        out = self._out = []
        while self._timers and self._timers[0][0] <= now:
            heappop(self._timers)[2](now)
        if self._zero is not None:
            while self._strike_at() <= now:
                self._strike(self._source.take(), now)
        while (held := self.held.take(now)) is not None:
            self._let_go(_Stage(held[3]), held[2], now, out)
        wish = self.device.wake_at
        if wish is not None and wish <= now:
            out += self._pass_on(self.device.wake(now), now)
        return out

    def _let_go(self, stage: _Stage, frame: Frame, now: Instant, out: list[Frame]) -> None:
        """Release a frame held in ``stage``."""
        if stage is _Stage.COMING:
            out += self._hear(frame, now)
        elif self._deaf(now):
            return
        elif stage is _Stage.INSIDE and self._fates is not None:
            self._meet_fate(_Stage.LEAVING, frame, now, out)
        else:
            out.append(frame)

    def _meet_fate(self, stage: _Stage, frame: Frame, now: Instant, out: list[Frame]) -> None:
        """At the connection: ``frame`` goes on at once, later, changed or not at all."""
        fates = self._fates
        assert fates is not None
        way = Direction.HOST_TO_DRIVE if stage is _Stage.COMING else Direction.DRIVE_TO_HOST
        for one, later in fates.goes_on(int(way), frame, now):
            if later == 0:
                self._let_go(stage, one, now, out)
            else:
                self.held.hold(one, now + later, stage)

    def follow_bit_rate(self, set_bit_rate: Callable[[int], None]) -> None:
        """The device's own affair."""
        self.device.follow_bit_rate(set_bit_rate)

    def bus_off(self, now: Instant) -> None:
        """Its controller tells: what was held for sending is gone."""
        self.held.clear()
        self.device.bus_off(now)

    def bus_recovered(self, now: Instant) -> Sequence[Frame]:
        """Its controller tells."""
        return self._pass_on(self.device.bus_recovered(now), now)

    def _strike_at(self) -> int:
        assert self._zero is not None
        due = self._source.next_at()
        return NEVER if due == NEVER else self._zero + due

    def _deaf(self, now: Instant) -> bool:
        return now < self._silent_until or self._off

    def _boot_time(self) -> int:
        """The device has just been started; what it was about to send is gone."""
        takes = self._source.boot_time()
        n, self._boots = self._boots, self._boots + 1
        if takes and self._log is not None:
            self._log.note(_BOOT, self._now - self._powered_at, self.node_id, 0, n, takes)
        self.held.clear()
        return takes

    def _pass_on(self, frames: Sequence[Frame], now: Instant) -> Sequence[Frame]:
        """``frames`` as they go out: at once, later, or never."""
        if self._deaf(now):
            return _NOTHING
        out: list[Frame] = []
        for frame in frames:
            late = self._source.lateness(frame.can_id)
            key = frame.can_id | EXTENDED_FLAG if frame.extended else frame.can_id
            n = self._frames.get(key, 0)
            self._frames[key] = n + 1
            release = now + late
            if late and self._log is not None:
                self._log.note(_LATE, now - self._powered_at, self.node_id, key, n, late)
            if late:
                release = self._queues[frame.can_id >= 0x580].behind(release)
            if release > now:
                self.held.hold(frame, release, _Stage.INSIDE)
            elif self._fates is None:
                out.append(frame)
            else:
                self._meet_fate(_Stage.LEAVING, frame, now, out)
        return out

    def _strike(self, event: NodeEvent, now: Instant) -> None:
        at_ns, kind, a, b, c = event
        if self._log is not None:
            self._log.note(KIND_CODES[kind], at_ns, self.node_id, 0, 0, a, b, c)
            self._log.flush()  # rare, and to be told at once
        node_kind(kind).befall(self, now, event)

    # What a fault can do to a node, see :class:`servobench.virtual_bus.faults.node_fault.StruckNode`.

    def silence(self, until: int) -> None:
        """Neither hear nor send."""
        self._silent_until = max(self._silent_until, until)

    def step_clock(self, step_ns: int) -> None:
        """Its clock jumps."""
        self.device.clock.step(step_ns)

    def drift_clock(self, drift_ppb: int, now: Instant) -> None:
        """Its clock runs faster by so much more."""
        self.device.clock.drift_more(drift_ppb, now)

    def answer_scan_in_configuration(self) -> None:
        """It says yes to every fast scan once it is in LSS state CONFIGURATION."""
        self.device.answer_scan_in_configuration()

    def go_bus_off(self, now: Instant, recover_after_ns: int | None) -> None:
        """Its controller goes off, and recovers after that time; None: never."""
        if self._off:
            return
        if recover_after_ns is not None:
            self.later(now + recover_after_ns, self._recover)
        if self.controller is not None:
            self.controller.go_bus_off()
            return
        self.bus_off(now)
        self._off = True

    def _recover(self, now: Instant) -> None:
        if self.controller is not None:
            self.controller.recover()
            return
        self._off = False
        self._out += self.bus_recovered(now)

    def fail(self, code: int, register: ErrorRegister, now: Instant) -> None:
        """The drive finds an error of its own."""
        self._befall_drive(lambda drive: drive.fail(code, register), now)

    def hold_encoder(self, held: bool, now: Instant) -> None:
        """Its encoder stands still at its last count, or goes on."""
        self._befall_drive(lambda drive: drive.firmware.hold_encoder(held), now)

    def damage(self, act: Callable[[DamagedDrive], None], now: Instant) -> None:
        """Something of it, or of its machine, breaks or wears, or is whole again."""
        self._befall_drive(lambda drive: act(drive.firmware.damage), now)

    def open_sto(self, opened: bool, now: Instant) -> None:
        """Its input for safe torque off opens, or closes again."""
        self._befall_drive(lambda drive: drive.machine.switch_sto(int(opened)), now)

    def scale_supply(self, share: float, now: Instant) -> None:
        """Its source gives that share of its voltage."""
        self._befall_drive(lambda drive: drive.axis.scale_supply(share), now)

    def take_mode(self, mode: int, now: Instant) -> None:
        """It takes that mode of operation by itself."""
        self._befall_drive(lambda drive: drive.take_mode(mode), now)

    def leave_mode(self, mode: int, now: Instant) -> None:
        """It goes back to the mode of 6060h, if it still is in ``mode``."""
        self._befall_drive(lambda drive: drive.leave_mode(mode), now)

    def turn_deaf(self, zero: bool, hides_bit_12: bool, now: Instant) -> None:
        """It ignores set-points."""
        self._befall_drive(lambda drive: drive.turn_deaf(zero, hides_bit_12), now)

    def hear_again(self, now: Instant) -> None:
        """It follows set-points."""
        self._befall_drive(lambda drive: drive.hear_again(), now)

    def report_again(self, code: int, register: ErrorRegister, now: Instant) -> None:
        """It sends an EMCY, once more if it did already, while it is enabled."""
        self._befall_drive(lambda drive: drive.report_again(code, register), now)

    def refuse_mapping(self, index: int, subindex: int, abort: int, mapped: int) -> None:
        """It refuses what is written to a mapping parameter; index 0: to every entry of every PDO."""
        for entry in self.device.dictionary:
            if entry.index != index and (index or not is_mapping(entry.index)):
                continue
            for place, variable in entry.members.items():
                if place == subindex if index else place:
                    variable.check = _refusal(variable.check, AbortCode(abort), mapped)

    def later(self, due: int, action: Callable[[Instant], None]) -> None:
        """Do something at ``due``."""
        self._order += 1
        heappush(self._timers, (due, self._order, action))

    def _befall_drive(self, act: "Callable[[ServoApplication], None]", now: Instant) -> None:
        """The drive is brought to ``now``, ``act`` happens to it, and it reacts."""
        drive = cast("ServoApplication", self.device.application)  # see Injection.wrap
        frames = list(self.device.wake(now))
        act(drive)
        frames += self.device.wake(now)
        self._out += self._pass_on(frames, now)


def _refusal(own: Check | None, abort: AbortCode, mapped: int) -> Check:
    """A check of a mapping parameter before its ``own``."""

    def check(value: int) -> AbortCode | None:
        if mapped in (0, value >> 8):
            return abort
        return None if own is None else own(value)

    return check
