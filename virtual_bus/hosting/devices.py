"""Devices at work: on a segment in simulated time, or on any python-can bus in real time."""

import errno
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import can

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NEVER, NS_PER_MS, Clock, Instant
from servobench.drivers.wire.frame_port import ERROR_FLAG, FramePort
from servobench.drivers.wire.message_port import MessagePort, StampSource
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.error_message import told_bus_off
from servobench.virtual_bus.bus.listener import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.core.native import DeviceSeat
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.frame import Device, Frame

POLL_NS: Final = 50 * NS_PER_MS
"""Longest time in one ``receive``, so that ``stop`` is noticed."""
CATCH_UP_MAX_NS: Final = 100 * NS_PER_MS
"""Longer than a process that runs is kept from its processor; a heartbeat may be missed for longer."""

LOOPED_FRAMES_MAX: Final = 4096
"""Frames that devices of one host may send each other at one instant; more is a loop among them."""


def _tell_state(device: Device, off: bool, now: Instant) -> Sequence[Frame]:
    """Tell a device that wants to know that its controller is bus-off, or back; what it then sends."""
    tell = getattr(device, "bus_off" if off else "bus_recovered", None)
    return () if tell is None else tell(now) or ()


class AttachedDevice(Listener):
    """A device on a segment, powered on when this is made, and woken by the segment's timeline; frames that a
    CANopen device listens to are handed to it by core/seat_type.c."""

    def __init__(self, device: Device, segment: CanSegment, name: str = "device") -> None:
        self.device = device
        self._timeline = timeline = segment.timeline
        self._cycle = device.cycle if isinstance(device, CanopenDevice) else None
        self.port = segment.attach(name, self)
        """Its place on the segment: to unplug, to take off the bus, to ask for error counters."""
        self._seat = DeviceSeat(self._cycle, self.port, can.CanOperationError, self._on_event)
        self.port.on_error_state = self._on_error_state
        self._off = False
        self._attached = True
        heard = getattr(device, "heard", None)
        if heard is not None:
            self.port.hear_only(heard, None if self._cycle is None else self._seat)
        follow = getattr(device, "follow_bit_rate", None)
        if follow is not None:
            follow(self.port.set_bitrate)
        self._send(device.start(timeline.now))
        self._schedule()

    @property
    def frames_lost(self) -> int:
        """Frames that did not fit into the port's transmit queue."""
        return self._seat.frames_lost

    def detach(self) -> None:
        """Unplug the device: it neither hears nor acts any more."""
        self._attached = False
        self.port.detach()

    def wake_now(self) -> None:
        """Let the device act at once, after something was done to it outside of the bus."""
        self._send(self.device.wake(self._timeline.now))
        self._schedule()

    def on_frame(self, frame: Frame, now: Instant) -> None:
        self._send(self.device.receive(frame, now))
        self._schedule()

    def _on_error_state(self, state: ErrorState, now: Instant) -> None:
        off = state is ErrorState.BUS_OFF
        if off or self._off:
            self._off = off
            self._send(_tell_state(self.device, off, now))
        self._schedule()

    def _send(self, frames: Sequence[Frame]) -> None:
        for frame in frames:
            self._seat.send(frame)

    def _due(self) -> Instant:
        if self._cycle is not None:
            return self._cycle.due_at
        due = self.device.wake_at
        return NEVER if due is None else due

    def _schedule(self) -> None:
        self._seat.wake_by(self._due())

    def _on_event(self, now: Instant) -> None:
        if now < self._seat.scheduled or not self._attached:
            return
        self._seat.scheduled = NEVER
        if self._due() <= now:
            self._send(self.device.wake(now))
            assert self._due() > now, "a device must not ask for a wake that has passed"
        self._schedule()


class RealTimeHost:
    """Devices of one process on one bus: single-threaded, time passes only in the port's ``receive``.

    A device's time is that of what befalls it, not of its process: a frame comes at its own stamp and a timer
    at its due instant, in their order, however late the process woke. So a drive samples at the SYNC; only
    its answers leave late. Time never runs backwards for a device, nor ahead of the clock.

    That the adapter is bus-off is known from the bus's ``state`` or from an error frame (SocketCAN); that it
    is back, from either of them or from any frame that it receives.
    """

    def __init__(self, devices: Sequence[Device], bus: can.BusABC, clock: Clock) -> None:
        self.frames_lost = 0
        """Frames that the adapter had no room for, or that were to be sent while it was bus-off."""
        self._off = self._off_by_state = False
        self._devices = devices
        self._bus = bus
        self._clock = clock
        port: FramePort | None = getattr(bus, "frame_port", None)
        self._port = MessagePort(bus, clock, StampSource.RECEIPT) if port is None else port
        self._now = Instant(0)
        """How far the devices have come."""

    def serve(self, stop: Callable[[], bool]) -> None:
        """Power the devices on and serve them until ``stop()``. Error: BusDown."""
        try:
            self._start()
            while not stop():
                self._turn()
        except can.CanError as error:
            raise BusDown(
                "the bus of the simulated devices went away",
                str(error),
                "bring the interface up and start the simulated devices again",
            ) from error

    def _start(self) -> None:
        self._now = now = self._clock.now()
        for device in self._devices:
            self._distribute(device, device.start(now))

    def _turn(self) -> None:
        port = self._port
        frame = port.receive(self._patience())
        now = self._clock.now()
        at = now if frame is None else min(port.came_at, now)
        off = self._is_off(frame)
        if off != self._off:
            self._off = off
            self._advance(at)
            for device in self._devices:
                self._distribute(device, _tell_state(device, off, self._now))
        self._wake(at)
        if frame is not None and frame.can_id < ERROR_FLAG and not port.came_own:
            self._advance(at)
            for device in self._devices:
                self._distribute(device, device.receive(frame, self._now))

    def _wake(self, until: Instant) -> None:
        """Let all timers run that are due by ``until``, each at its instant.

        A process that was stopped for longer than CATCH_UP_MAX_NS does not make up for all that it missed.
        """
        while True:
            due, device = self._next_wake()
            if device is None or due > until:
                return
            self._advance(max(due, Instant(until - CATCH_UP_MAX_NS)))
            self._distribute(device, device.wake(self._now))

    def _next_wake(self) -> tuple[Instant, Device | None]:
        first: tuple[Instant, Device | None] = (NEVER, None)
        for device in self._devices:
            due = device.wake_at
            if due is not None and due < first[0]:
                first = due, device
        return first

    def _advance(self, now: Instant) -> None:
        self._now = max(self._now, now)

    def _is_off(self, frame: Frame | None) -> bool:
        knew, self._off_by_state = self._off_by_state, self._bus.state is can.BusState.ERROR
        if self._off_by_state or knew:
            return self._off_by_state
        if frame is None:
            return self._off
        off = told_bus_off(frame.can_id) if frame.can_id >= ERROR_FLAG else False
        return self._off if off is None else off

    def _patience(self) -> Instant:
        """Until when to wait for a frame."""
        return min(self._next_wake()[0], Instant(self._clock.now() + POLL_NS))

    def _distribute(self, sender: Device, frames: Sequence[Frame]) -> None:
        """Send, and let the other devices of this host hear it: a bus returns own frames only as echoes."""
        queue = deque((sender, frame) for frame in frames)
        handled = 0
        while queue:
            source, frame = queue.popleft()
            handled += 1
            self._send(frame)
            if len(self._devices) == 1 or handled > LOOPED_FRAMES_MAX:
                continue
            for device in self._devices:
                if device is not source:
                    queue.extend((device, answer) for answer in device.receive(frame, self._now))

    def _send(self, frame: Frame) -> None:
        if self._off:
            self.frames_lost += 1
            return
        try:
            self._port.transmit(frame)
        except can.CanOperationError as error:
            # A full transmit queue loses the frame, as in a drive; anything else is a dead bus.
            if error.error_code != errno.ENOBUFS:
                raise
            self.frames_lost += 1


def serve(devices: Sequence[Device], bus: can.BusABC, clock: Clock, stop: Callable[[], bool]) -> None:
    """Run ``devices`` on a real-time bus until ``stop()``. Error: BusDown."""
    RealTimeHost(devices, bus, clock).serve(stop)
