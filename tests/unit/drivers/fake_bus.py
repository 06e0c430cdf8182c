"""A bus and one scripted servo node in a few lines of simulated time, for tests of the drive client."""

import heapq
from collections.abc import Callable
from struct import pack, unpack
from typing import Any

import can

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.profile import (
    STATUS_PATTERNS,
    TRANSITION_OF,
    DriveCommand,
    DriveEvent,
    State,
    commands_in,
)
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Instant
from servobench.drivers.wire.frame_port import FramePort, WireFrame
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.write_lists import RIG

PDOS = 4
ANSWER_AFTER_NS = 100 * NS_PER_US
MISSING, READ_ONLY, DEVICE_STATE = 0x06020000, 0x06010002, 0x08000022
TOGGLE_NOT_ALTERNATED, COMMAND_NOT_VALID = 0x05030000, 0x05040001

TYPES = {
    (0x1000, 0): "I",
    (0x1006, 0): "I",
    (0x1013, 0): "I",
    (0x1016, 0): "B",
    (0x1016, 1): "I",
    (0x1016, 2): "I",
    (0x1017, 0): "H",
    (0x1018, 1): "I",
    (0x1018, 2): "I",
    (0x1018, 3): "I",
    (0x1018, 4): "I",
    (0x2100, 1): "i",
    (0x6007, 0): "h",
    (0x603F, 0): "H",
    (0x6040, 0): "H",
    (0x6041, 0): "H",
    (0x605A, 0): "h",
    (0x605C, 0): "h",
    (0x605E, 0): "h",
    (0x6060, 0): "b",
    (0x6061, 0): "b",
    (0x6064, 0): "i",
    (0x606C, 0): "i",
    (0x6071, 0): "h",
    (0x6072, 0): "H",
    (0x6074, 0): "h",
    (0x6076, 0): "I",
    (0x6077, 0): "h",
    (0x6080, 0): "I",
    (0x6085, 0): "I",
    (0x608F, 1): "I",
    (0x608F, 2): "I",
    (0x60A9, 0): "I",
    (0x6502, 0): "I",
}
INITIAL = {
    (0x1000, 0): 0x00020192,
    (0x1016, 0): 2,
    (0x1018, 1): 0x1234,
    (0x6076, 0): 2000,
    (0x608F, 1): 65536,
    (0x608F, 2): 1,
    (0x60A9, 0): 0xFDB44700,
    (0x6502, 0): 1 << 9,
    (0x605A, 0): 2,
}


class FakePort(FramePort):
    """Frames over the event heap of a :class:`FakeBus`."""

    def __init__(self, bus: "FakeBus") -> None:
        super().__init__()
        self._bus = bus

    def receive(self, until: Instant) -> WireFrame | None:
        arrival = self._bus.next_arrival(until)
        if arrival is None:
            return None
        frame, self.came_at = arrival
        return frame

    def transmit(self, frame: WireFrame) -> None:
        self._bus.note_sent(frame)


class FakeBus(can.BusABC):
    """A bus that is an event heap; its own clock is the bench's clock."""

    def __init__(self) -> None:
        super().__init__(channel="fake")
        self.channel_info = "fake"
        self.time = Instant(0)
        self.sent: list[tuple[Instant, WireFrame]] = []
        self.listeners: list[Callable[[WireFrame], None]] = []
        self.broken = False
        self.frame_port = FakePort(self)
        self._inbox: list[tuple[WireFrame, Instant]] = []
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = 0

    def now(self) -> Instant:
        return self.time

    def sleep_until(self, when: Instant) -> None:
        self._run_until(when, lambda: False)

    def call_after(self, delay_ns: int, action: Callable[[], None]) -> None:
        self._order += 1
        heapq.heappush(self._events, (self.time + delay_ns, self._order, action))

    def deliver(self, can_id: int, data: bytes, after_ns: int = 0, **flags: Any) -> None:
        frame = WireFrame(can_id, data, **flags)
        self.call_after(after_ns, lambda: self._inbox.append((frame, self.time)))

    def next_arrival(self, until: Instant) -> tuple[WireFrame, Instant] | None:
        if self.broken:
            raise can.CanOperationError("the adapter is gone")
        self._run_until(until, lambda: bool(self._inbox))
        return self._inbox.pop(0) if self._inbox else None

    def note_sent(self, frame: WireFrame) -> None:
        if self.broken:
            raise can.CanOperationError("the adapter is gone")
        self.sent.append((self.time, frame))
        for listener in self.listeners:
            listener(frame)

    def sent_to(self, can_id: int) -> list[bytes]:
        return [frame.data for _, frame in self.sent if frame.can_id == can_id]

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError

    def _run_until(self, until: Instant, done: Callable[[], bool]) -> None:
        while not done():
            if not self._events or self._events[0][0] > until:
                self.time = max(self.time, until)
                return
            when, _, action = heapq.heappop(self._events)
            self.time = Instant(max(self.time, when))
            action()


class FakeServo:
    """SDO server, heartbeat, NMT, the state machine of CiA 402 and SYNC-driven PDOs; no motor."""

    def __init__(self, bus: FakeBus, node_id: int = 1) -> None:
        self.bus, self.node_id = bus, node_id
        self.types = dict(TYPES)
        self.values: dict[tuple[int, int], int] = {place: INITIAL.get(place, 0) for place in TYPES}
        self.texts = {(0x1008, 0): b"Fake servo with a long name"}
        for base, mapping in ((0x1400, 0x1600), (0x1800, 0x1A00)):
            for number in range(PDOS):
                self._add_pdo(base + number, mapping + number)
        self.refuse: dict[tuple[int, int], int] = {}
        """Objects that refuse to be written, with the abort code."""
        self.stubborn: set[tuple[int, int]] = set()
        """Objects that confirm a write and keep their value."""
        self.silent = False
        self.deaf_to_sdo = 0
        """SDO requests still to be ignored."""
        self.sdo_takes_ns = ANSWER_AFTER_NS
        """From a request to its answer."""
        self.segments_lost = 0
        """So many segments of an upload are sent and lost, if they are the second of it."""
        self.lost_tpdos: set[int] = set()
        self.state = State.SWITCH_ON_DISABLED
        self.nmt_state = 0x7F
        self.mode_status = 0
        """Bits of the statusword that belong to the mode."""
        self.control_history: list[int] = []
        self.syncs = 0
        self._told: dict[int, tuple[bytes, int]] = {}
        """Of each event-driven TPDO what it told last, and when."""
        self.stop_ns = 5 * NS_PER_MS
        self._segments = b""
        self._toggle = 0
        bus.listeners.append(self._on_frame)
        self._beat()
        self._look()

    def _add_pdo(self, communication: int, mapping: int) -> None:
        for sub, code in ((0, "B"), (1, "I"), (2, "B"), (3, "H"), (5, "H")):
            self.types[communication, sub] = code
            self.values[communication, sub] = 0
        first = 0x180 if communication >= 0x1800 else 0x200
        self.values[communication, 1] = 0x80000000 | (first + 0x100 * (communication & 0xF) + self.node_id)
        self.values[communication, 2] = 255
        for sub in range(9):
            self.types[mapping, sub] = "I" if sub else "B"
            self.values[mapping, sub] = 0

    def fault(self, code: int) -> None:
        """Fall into a fault and tell it by EMCY."""
        self.values[0x603F, 0] = code
        self.state = State.FAULT
        self.bus.deliver(0x80 + self.node_id, pack("<HB5s", code, 1, b"\x01\x02\x03\x04\x05"))

    def boot(self) -> None:
        self.nmt_state = 0x7F
        self.bus.deliver(0x700 + self.node_id, b"\0")

    def _beat(self) -> None:
        period_ms = self.values[0x1017, 0] or 1
        if self.values[0x1017, 0] and not self.silent:
            self.bus.deliver(0x700 + self.node_id, bytes([self.nmt_state]))
        self.bus.call_after(period_ms * NS_PER_MS, self._beat)

    def _on_frame(self, frame: WireFrame) -> None:
        if self.silent:
            return
        if frame.can_id == 0 and frame.data[1] in (0, self.node_id):
            self.nmt_state = {1: 0x05, 2: 0x04, 0x80: 0x7F}[frame.data[0]]
        elif frame.can_id == 0x80 and self.nmt_state == 5:
            self.syncs += 1
            self._transmit()
        elif frame.can_id == 0x600 + self.node_id:
            self._serve(frame.data)
        elif self.nmt_state == 5:
            self._receive(frame)

    # ---- SDO ------------------------------------------------------------------------------------------

    def _serve(self, data: bytes) -> None:
        if self.deaf_to_sdo:
            self.deaf_to_sdo -= 1
            return
        command, index, sub = unpack("<BHB", data[:4])
        if command >> 5 == 1:
            answer = self._download(index, sub, data[4 : 8 - (command >> 2 & 3)])
        elif command >> 5 == 2:
            answer = self._upload(index, sub)
        elif command >> 5 == 3:
            if command & 0x10 != self._toggle or not self._segments:
                code = TOGGLE_NOT_ALTERNATED if self._segments else COMMAND_NOT_VALID
                self._segments = b""
                self.bus.deliver(0x580 + self.node_id, pack("<B3xI", 0x80, code), self.sdo_takes_ns)
                return
            part, self._segments = self._segments[:7], self._segments[7:]
            self._toggle ^= 0x10
            if command & 0x10 and self.segments_lost:
                self.segments_lost -= 1
                return
            head = command & 0x10 | (7 - len(part)) << 1 | (not self._segments)
            answer = bytes([head]) + part.ljust(7, b"\0")
        else:
            return
        self.bus.deliver(0x580 + self.node_id, answer, self.sdo_takes_ns)

    def _download(self, index: int, sub: int, data: bytes) -> bytes:
        place = index, sub
        if place not in self.types:
            return pack("<BHBI", 0x80, index, sub, MISSING)
        if place in self.refuse:
            return pack("<BHBI", 0x80, index, sub, self.refuse[place])
        pdo = index & 0xFE00 in (0x1400, 0x1600, 0x1800, 0x1A00)
        communication = index if index & 0x0200 == 0 else index - 0x200
        if pdo and index != communication and not self.values[communication, 1] >> 31:
            return pack("<BHBI", 0x80, index, sub, DEVICE_STATE)
        if place not in self.stubborn:
            (self.values[place],) = unpack("<" + self.types[place], data)
            self._written(index)
        return pack("<BHB4x", 0x60, index, sub)

    def _upload(self, index: int, sub: int) -> bytes:
        if (index, sub) in self.texts:
            self._segments, self._toggle = self.texts[index, sub], 0
            return pack("<BHBI", 0x41, index, sub, len(self._segments))
        if (index, sub) not in self.types:
            return pack("<BHBI", 0x80, index, sub, MISSING)
        data = self._encoded(index, sub)
        return pack("<BHB", 0x43 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0")

    def _encoded(self, index: int, sub: int) -> bytes:
        self.values[0x6041, 0] = STATUS_PATTERNS[self.state].value | 0x0200 | self.mode_status
        self.values[0x1013, 0] = (self.bus.time // NS_PER_US) & 0xFFFFFFFF
        return pack("<" + self.types[index, sub], self.values[index, sub])

    def _written(self, index: int) -> None:
        if index == 0x6060:
            self.values[0x6061, 0] = self.values[0x6060, 0]
        if index == 0x6040:
            self._control(self.values[0x6040, 0])

    # ---- CiA 402 --------------------------------------------------------------------------------------

    def _control(self, word: int) -> None:
        self.control_history.append(word)
        commands = [*commands_in(word), *([DriveCommand.FAULT_RESET] if word & 0x80 else [])]
        for command in commands:
            arrow = TRANSITION_OF.get((self.state, command))
            if arrow is not None:
                self.state = arrow.target
                if self.state is State.QUICK_STOP:
                    self.bus.call_after(self.stop_ns, self._stopped)
                return

    def _stopped(self) -> None:
        self.values[0x606C, 0] = 0
        arrow = TRANSITION_OF.get((self.state, DriveEvent.QUICK_STOP_DONE))
        if arrow is not None and self.values[0x605A, 0] < 5:
            self.state = arrow.target

    # ---- PDO ------------------------------------------------------------------------------------------

    def _mapped(self, mapping: int) -> list[tuple[int, int]]:
        words = [self.values[mapping, sub] for sub in range(1, self.values[mapping, 0] + 1)]
        return [(word >> 16, word >> 8 & 0xFF) for word in words]

    def _transmit(self) -> None:
        """The synchronous TPDOs, each with every so many SYNCs as its transmission type says."""
        for number in range(PDOS):
            kind = self.values[0x1800 + number, 2]
            if 1 <= kind <= 240 and self.syncs % kind == 0:
                self._send_tpdo(number, (number + 1) * 130 * NS_PER_US)

    def _look(self) -> None:
        """The event-driven TPDOs: on change, and by their event timers; looked at every 100 us."""
        for number in range(PDOS):
            if self.nmt_state != 5 or self.silent or self.values[0x1800 + number, 2] < 254:
                continue
            data, told_at = self._told.get(number, (b"", 0))
            timer_ns = self.values[0x1800 + number, 5] * NS_PER_MS
            if self._tpdo(number) != data or (timer_ns and self.bus.time - told_at >= timer_ns):
                self._told[number] = (self._tpdo(number), self.bus.time)
                self._send_tpdo(number, 0)
        self.bus.call_after(100 * NS_PER_US, self._look)

    def _tpdo(self, number: int) -> bytes:
        return b"".join(self._encoded(*place) for place in self._mapped(0x1A00 + number))

    def _send_tpdo(self, number: int, after_ns: int) -> None:
        cob_id = self.values[0x1800 + number, 1]
        if not cob_id >> 31 and number + 1 not in self.lost_tpdos:
            self.bus.deliver(cob_id & 0x7FF, self._tpdo(number), after_ns)

    def _receive(self, frame: WireFrame) -> None:
        for number in range(PDOS):
            if frame.can_id == self.values[0x1400 + number, 1]:
                places = self._mapped(0x1600 + number)
                codes = "<" + "".join(self.types[place] for place in places)
                for place, value in zip(places, unpack(codes, frame.data), strict=True):
                    self.values[place] = value
                    self._written(place[0])


def make_network() -> tuple[FakeBus, CanopenNetwork]:
    """A network on a fake bus that nobody else is on."""
    bus = FakeBus()
    link = BusLink(bus, bus, StampSource.MONOTONIC, "fake")
    return bus, CanopenNetwork(link, bus, writes=RIG)
