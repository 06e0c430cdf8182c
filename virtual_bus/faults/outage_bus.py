"""The host's own CAN adapter, which now and then takes no frames or gives none."""

import os
from collections import deque
from collections.abc import Iterator
from functools import partial
from heapq import merge
from typing import Any

import can
from can.broadcastmanager import CyclicSendTaskABC

from servobench.drivers.timebase import NEVER, Clock, Instant
from servobench.drivers.wire.frame_port import FramePort, Trouble, WireFrame
from servobench.drivers.wire.link import StampSource
from servobench.drivers.wire.message import frame_of
from servobench.drivers.wire.message_port import MessagePort
from servobench.virtual_bus.faults.fates import RecordedFaults
from servobench.virtual_bus.faults.fault_log import KIND_CODES, FaultLog
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.fault_streams import uniform_stream
from servobench.virtual_bus.faults.kinds.full_queue import FullQueue
from servobench.virtual_bus.faults.kinds.link_down import LinkDown
from servobench.virtual_bus.faults.kinds.receive_overflow import ReceiveOverflow
from servobench.virtual_bus.faults.node_fault import AdapterOutage, NodeEvent
from servobench.virtual_bus.faults.node_faults import Events

KINDS: dict[str, type[AdapterOutage]] = {kind.kind: kind for kind in (FullQueue, LinkDown, ReceiveOverflow)}


class Deafness:
    """Interval in which frames to the host are lost."""

    def __init__(self, kind: type[AdapterOutage], since: Instant, until: Instant) -> None:
        self.kind = kind
        self.since = since
        self.until = until
        self.begun = False
        """True once its begin was reported."""
        self.unheard = 0
        """Frames."""


class Outages:
    """When which outage is in force. Of two at a time the one counts that began last."""

    def __init__(self, events: Iterator[NodeEvent], log: FaultLog | None) -> None:
        self._events = Events(events)
        self._log = log
        self._zero: Instant | None = None
        self._kind: type[AdapterOutage] | None = None
        self._until = Instant(0)
        """When that one ends."""
        self.deafnesses: deque[Deafness] = deque()
        """Those that have begun, the oldest first; whoever hears no more of one takes it out."""

    @classmethod
    def of(
        cls, faults: FaultPlan | RecordedFaults, seed: int, link: str, log: FaultLog | None
    ) -> "Outages | None":
        """Those of a plan, or as they were in a recorded run; None if there are none."""
        if isinstance(faults, RecordedFaults):
            mine = [entry for entry in faults.entries if entry.kind in KINDS]
            events = iter([NodeEvent(entry.at_ns, entry.kind, entry.a) for entry in mine])
            return cls(events, log) if mine else None
        tables = [
            outage.events(partial(uniform_stream, seed, f"{link}/adapter/{outage.kind}/{place}"))
            for place, outage in enumerate(faults.outages)
        ]
        return cls(merge(*tables, key=lambda event: event.at_ns), log) if tables else None

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``."""
        self._zero = now

    def stop(self) -> None:
        """From here on the adapter is sound."""
        self._zero, self._kind = None, None

    def now(self, at: Instant) -> type[AdapterOutage] | None:
        """The one in force at ``at``; instants must not fall."""
        zero = self._zero
        if zero is None:
            return None
        while zero + self._events.next_at() <= at:
            event = self._events.take()
            begins = Instant(zero + event.at_ns)
            self._kind, self._until = KINDS[event.kind], Instant(begins + event.a)
            if self.deafnesses:
                self.deafnesses[-1].until = min(self.deafnesses[-1].until, begins)
            if not self._kind.hears:
                self.deafnesses.append(Deafness(self._kind, begins, self._until))
            if self._log is not None:
                self._log.note(KIND_CODES[event.kind], event.at_ns, 0, 0, 0, event.a)
        if at >= self._until:
            self._kind = None
        return self._kind

    def next_at(self) -> Instant:
        """When the next one begins, or the present one ends."""
        if self._zero is None:
            return NEVER
        begins = min(NEVER, self._zero + self._events.next_at())
        return Instant(begins if self._kind is None else min(begins, self._until))


class OutagePort(FramePort):
    """``inner``, out of order where ``outages`` says so."""

    def __init__(self, inner: FramePort, outages: Outages, clock: Clock) -> None:
        super().__init__()
        self.echoes, self.needs_watching, self.troubles = inner.echoes, inner.needs_watching, inner.troubles
        self._inner = inner
        self._outages = outages
        self._now = clock.now

    def receive(self, until: Instant) -> WireFrame | None:
        """The next frame that is heard; what came while nothing was heard is gone."""
        while True:
            self._note()
            step = min(until, self._outages.next_at())
            frame = self._inner.receive(step)
            self._note()
            if frame is None:
                self._end_deafnesses(self._now())
                if step >= until:
                    return None
            elif not self._gone(self._inner.came_at):
                self.came_at, self.came_own = self._inner.came_at, self._inner.came_own
                self.echoes = self._inner.echoes
                return frame

    def transmit(self, frame: WireFrame) -> None:
        """Hand ``frame`` on. Raises can.CanOperationError as a kernel does."""
        outage = self._note()
        if outage is not None and outage.code is not None:
            raise can.CanOperationError(f"cannot transmit: {os.strerror(outage.code)}", outage.code)
        self._inner.transmit(frame)

    def _note(self) -> type[AdapterOutage] | None:
        now = self._now()
        outage = self._outages.now(now)
        for deafness in self._outages.deafnesses:
            if not deafness.begun:
                deafness.begun = True
                if deafness.kind.begins:
                    self.troubles.append(Trouble(deafness.kind.begins, now))
        return outage

    def _gone(self, came_at: Instant) -> bool:
        """Return True if a frame of that instant was not received."""
        self._end_deafnesses(came_at)
        deafnesses = self._outages.deafnesses
        if not deafnesses or came_at < deafnesses[0].since:
            return False
        deafnesses[0].unheard += 1
        return True

    def _end_deafnesses(self, at: Instant) -> None:
        """End deafnesses: frames from ``at`` on come after some of them, and none from within them any
        more."""
        deafnesses = self._outages.deafnesses
        while deafnesses and deafnesses[0].until <= at:
            deafness = deafnesses.popleft()
            if deafness.unheard or deafness.kind.begins:
                text = deafness.kind.ends.format(unheard=deafness.unheard)
                self.troubles.append(Trouble(text, self._now(), unheard=True))


class OutageBus(can.BusABC):
    """``bus`` seen through ``outages``, for a link: received is by its ``frame_port`` alone."""

    def __init__(
        self, bus: can.BusABC, outages: Outages, clock: Clock, stamps: StampSource = StampSource.RECEIPT
    ) -> None:
        """``stamps``: those of a bus that has no ``frame_port``."""
        self.inner = bus
        self.channel_info = bus.channel_info
        self._can_protocol = bus.protocol
        self._clock = clock
        inner: FramePort = getattr(bus, "frame_port", None) or MessagePort(bus, clock, stamps)
        self.frame_port = OutagePort(inner, outages, clock)
        super().__init__(channel="", can_filters=bus.filters)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Hand ``msg`` on. Raises can.CanOperationError while there is no room."""
        self.frame_port.transmit(frame_of(msg))

    def shutdown(self) -> None:
        """Close ``bus``."""
        super().shutdown()
        self.inner.shutdown()

    def _send_periodic_internal(self, *arguments: Any, **options: Any) -> CyclicSendTaskABC:
        return self.inner._send_periodic_internal(*arguments, **options)
