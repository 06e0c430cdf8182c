"""A device that things happen to: it stands between a host and a simulated device.

    host -- receive, wake -->  FaultyDevice  -- receive, wake, bus_off ... -->  device
         <-- frames -- lost while it is silent or boots, held while it is slow --

With fates it is a gateway too: frames in and out of the device are lost or held as those say, which no
echo at the sender tells. It works on any bus, for it only lets through or keeps back what passes. A device
that nothing ever befalls is not wrapped. A restart of the clock's drift at power-on is the device's own
affair.
"""

from collections.abc import Callable, Sequence
from enum import IntEnum
from heapq import heappop, heappush
from typing import Protocol

from drivers.canopen.error_codes import ErrorRegister
from drivers.canopen.nmt_states import NmtState
from drivers.timebase import Duration, Instant
from virtual_bus.bus.host_port import HELD_MAX
from virtual_bus.bus.judge import LOST
from virtual_bus.device.application import Application
from virtual_bus.device.device_clock import DeviceClock
from virtual_bus.faults.fates import FateSource
from virtual_bus.faults.fault_log import EXTENDED_FLAG, KIND_CODES, NONE, FaultLog
from virtual_bus.faults.fault_plan import Direction
from virtual_bus.faults.node_fault_plan import DriveFailure
from virtual_bus.faults.node_faults import NEVER, NodeEvent, NodeSource
from virtual_bus.frame import Device, Frame

_NOTHING: tuple[Frame, ...] = ()
_FAILURES = list(DriveFailure)
_NMT_RESETS = (0x81, 0x82)
"""Reset node, reset communication (CiA 301, 7.2.8.3.1.2)."""
_LATE, _BOOT = KIND_CODES["late"], KIND_CODES["boot"]


class SimulatedNode(Device, Protocol):
    """The device inside: a :class:`virtual_bus.device.canopen_device.CanopenDevice`."""

    clock: DeviceClock

    @property
    def node_id(self) -> int: ...

    @property
    def state(self) -> NmtState: ...

    @property
    def application(self) -> Application: ...

    def follow_bit_rate(self, set_bit_rate: Callable[[int], None]) -> None: ...

    def bus_off(self, now: Instant) -> None: ...

    def bus_recovered(self, now: Instant) -> Sequence[Frame]: ...


class FailingDrive(Protocol):
    """What an application must be able to do to fail."""

    def fail(self, code: int, register: ErrorRegister) -> None: ...

    def hold_encoder(self, held: bool) -> None: ...


class BusOffControl(Protocol):
    """The node's CAN controller, where the bus has error counters; it tells the device by itself."""

    def go_bus_off(self) -> None: ...

    def recover(self) -> None: ...


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
        device: SimulatedNode,
        source: NodeSource,
        log: FaultLog | None = None,
        fates: FateSource | None = None,
    ) -> None:
        """``fates``: what befalls frames at the device's connection to the bus."""
        self.device = device
        self.overflow = 0
        """Frames lost because too many were held."""
        self._fates = fates
        self.controller: BusOffControl | None = None
        """None: bus-off is acted out here, by silence."""
        self._source = source
        self._log = log
        self._zero: Instant | None = None
        self._powered_at = Instant(0)
        self._silent_until = 0
        self._boot: tuple[int, Sequence[Frame]] | None = None
        self._boots = 0
        self._off = False
        self._timers: list[tuple[int, int, str, int]] = []
        self._held: list[tuple[int, int, _Stage, Frame]] = []
        self._queues: dict[int, int] = {}
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
        """Of the device inside."""
        return self.device.node_id

    @property
    def wake_at(self) -> Instant | None:
        """The earliest of the device's own wish and of what is planned for it."""
        due = NEVER if self._zero is None else self._strike_at()
        if self._timers and self._timers[0][0] < due:
            due = self._timers[0][0]
        if self._held and self._held[0][0] < due:
            due = self._held[0][0]
        if self._boot is not None and self._boot[0] < due:
            due = self._boot[0]
        wish = self.device.wake_at
        if wish is not None and wish < due:
            return wish
        return None if due == NEVER else Instant(due)

    def start(self, now: Instant) -> Sequence[Frame]:
        """Power on."""
        self._powered_at = now
        return self._booting(self.device.start(now), now)

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
        frames = self.device.receive(frame, now)
        command = frame.data
        resets = frame.can_id == 0 and len(command) == 2 and command[0] in _NMT_RESETS
        if resets and command[1] in (0, self.node_id):
            return self._booting(frames, now)
        return self._pass_on(frames, now) if frames else _NOTHING

    def wake(self, now: Instant) -> Sequence[Frame]:
        """Whatever is due: what strikes, what ends, what was held, and the device's own timers."""
        out: list[Frame] = []
        while self._timers and self._timers[0][0] <= now:
            _, _, what, number = heappop(self._timers)
            self._end(what, number, now, out)
        if self._zero is not None:
            while self._strike_at() <= now:
                self._strike(self._source.take(), now, out)
        if self._boot is not None and self._boot[0] <= now:
            boot_up = self._boot[1]
            self._boot = None
            out += self._pass_on(boot_up, now)
        while self._held and self._held[0][0] <= now:
            _, _, stage, frame = heappop(self._held)
            self._let_go(stage, frame, now, out)
        wish = self.device.wake_at
        if wish is not None and wish <= now:
            out += self._pass_on(self.device.wake(now), now)
        return out

    def _let_go(self, stage: _Stage, frame: Frame, now: Instant, out: list[Frame]) -> None:
        """What was held in ``stage`` goes on."""
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
        delay = fates.hold(int(way), frame.can_id, now, frame.extended)
        goes_on = fates.replacements(frame) if delay == LOST else ((frame, Duration(delay)),)
        for one, later in goes_on:
            if later == 0:
                self._let_go(stage, one, now, out)
            else:
                self._hold(now + later, stage, one)

    def _hold(self, release: int, stage: _Stage, frame: Frame) -> None:
        if len(self._held) >= HELD_MAX:
            self.overflow += 1
            return
        self._order += 1
        heappush(self._held, (release, self._order, stage, frame))

    def follow_bit_rate(self, set_bit_rate: Callable[[int], None]) -> None:
        """The device's own affair."""
        self.device.follow_bit_rate(set_bit_rate)

    def bus_off(self, now: Instant) -> None:
        """Its controller tells: what was held for sending is gone."""
        self._held.clear()
        self.device.bus_off(now)

    def bus_recovered(self, now: Instant) -> Sequence[Frame]:
        """Its controller tells."""
        return self._pass_on(self.device.bus_recovered(now), now)

    def _strike_at(self) -> int:
        assert self._zero is not None
        due = self._source.next_at()
        return NEVER if due == NEVER else self._zero + due

    def _deaf(self, now: Instant) -> bool:
        return now < self._silent_until or self._off or (self._boot is not None and now < self._boot[0])

    def _booting(self, frames: Sequence[Frame], now: Instant) -> Sequence[Frame]:
        """The device has just been started; it takes its time for the boot-up."""
        takes = self._source.boot_time()
        n, self._boots = self._boots, self._boots + 1
        if takes == 0:
            return self._pass_on(frames, now)
        if self._log is not None:
            self._log.note(_BOOT, now - self._powered_at, self.node_id, 0, n, takes)
        self._held.clear()
        self._boot = (now + takes, frames)
        return _NOTHING

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
            # One queue for the PDOs and one for the SDO answers: each keeps its order.
            queue = 1 if frame.can_id >= 0x580 else 0
            release = now + late
            if late and self._log is not None:
                self._log.note(_LATE, now - self._powered_at, self.node_id, key, n, late)
            if late:
                release = self._queues[queue] = max(release, self._queues.get(queue, 0))
            if release > now:
                self._hold(release, _Stage.INSIDE, frame)
            elif self._fates is None:
                out.append(frame)
            else:
                self._meet_fate(_Stage.LEAVING, frame, now, out)
        return out

    def _strike(self, event: NodeEvent, now: Instant, out: list[Frame]) -> None:
        at_ns, kind, a, b, c = event
        if self._log is not None:
            self._log.note(KIND_CODES[kind], at_ns, self.node_id, 0, 0, a, b, c)
            self._log.flush()  # rare, and to be told at once
        if kind == "silence":
            self._silent_until = max(self._silent_until, now + a)
        elif kind == "bus_off":
            self._go_bus_off(now, a)
        elif kind == "clock_step":
            self.device.clock.step(a)
        elif kind == "clock_drift":
            self.device.clock.drift_more(a, now)
        else:
            self._fail(a, now, b, c, out)

    def _go_bus_off(self, now: Instant, recover_after_ns: int) -> None:
        if self._off:
            return
        if recover_after_ns != NONE:
            self._at(now + recover_after_ns, "recover", 0)
        if self.controller is not None:
            self.controller.go_bus_off()
            return
        self.bus_off(now)
        self._off = True

    def _fail(self, failure: int, now: Instant, detected_after: int, lasts: int, out: list[Frame]) -> None:
        if _FAILURES[failure] is not DriveFailure.ENCODER_LOSS:
            self._raise(failure, now, out)
            return
        out += self._pass_on(self.device.wake(now), now)
        self._drive().hold_encoder(True)
        self._at(now + detected_after, "detected", failure)
        self._at(now + lasts, "encoder back", failure)

    def _at(self, due: int, what: str, number: int) -> None:
        self._order += 1
        heappush(self._timers, (due, self._order, what, number))

    def _end(self, what: str, number: int, now: Instant, out: list[Frame]) -> None:
        if what == "detected":
            self._raise(number, now, out)
        elif what == "encoder back":
            out += self._pass_on(self.device.wake(now), now)
            self._drive().hold_encoder(False)
        elif self.controller is not None:
            self.controller.recover()
        else:
            self._off = False
            out += self.bus_recovered(now)

    def _raise(self, failure: int, now: Instant, out: list[Frame]) -> None:
        found = _FAILURES[failure]
        frames = list(self.device.wake(now))
        self._drive().fail(found.code, found.register)
        frames += self.device.wake(now)
        out += self._pass_on(frames, now)

    def _drive(self) -> FailingDrive:
        drive: FailingDrive = self.device.application  # type: ignore[assignment]
        return drive
