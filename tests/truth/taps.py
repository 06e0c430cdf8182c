"""Taps in simulated time: what was handed over, what was on the bus, what each drive heard and answered.

    loop -- HostTap -- faults -- segment -- faults -- DriveTap -- drive
            handed     of the     |  bus     of the    heard, answers
            fetched    host's side          drive's side

A frame is one object all the way: the faults hold, repeat and reorder the object itself. So a reading is
traced back to its SYNC by identity. Only damaged data would break the chain, and no plan here damages any.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import UNTOLD, FramePort
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.core.native import DeviceClock
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.device.station import Application
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame

SYNC_ID = 0x080
PDO_IDS = range(0x180, 0x580)
"""PDO 1..4 of the pre-defined connection set (CiA 301, table 39)."""
_COB_ID = 0x7FF
_NOT_VALID = 1 << 31
_PDOS = range(4)


class Passed(NamedTuple):
    """A frame at one of the taps."""

    at: Instant
    frame: Frame


class Heard(NamedTuple):
    """A SYNC at the drive, behind every fault of the drive's side."""

    at: Instant
    """The instant of sampling: the end of the SYNC frame at the drive, or later where its task acts later."""
    frame: Frame
    answers: Sequence[Frame]
    """What the drive sent in answer."""
    clock_ns: int
    """What the drive's clock showed."""


class HeardCommand(NamedTuple):
    """An RPDO at the drive."""

    at: Instant
    frame: Frame
    syncs_before: int
    """SYNCs that it had heard by then: one and the other may come in one instant."""


@dataclass(frozen=True, slots=True)
class Field:
    """Where an object lies in a PDO."""

    can_id: int
    first_byte: int
    bytes: int

    def of(self, frame: Frame, signed: bool) -> int:
        """The raw value in ``frame``, little endian (CiA 301, 7.1.4)."""
        raw = frame.data[self.first_byte : self.first_byte + self.bytes]
        return int.from_bytes(raw, "little", signed=signed)


@dataclass(frozen=True, slots=True)
class PdoLayout:
    """The PDOs of a drive, as its own dictionary has them at the first SYNC that it answers."""

    each_sync: tuple[int, ...]
    """COB-IDs of the TPDOs that come with every SYNC."""
    sent: dict[int, Field]
    """Index of an object -> its place in a TPDO."""
    command_id: int
    command_is_synchronous: bool
    """RPDO1 acts at the next SYNC; else on arrival."""
    controlword: Field
    """In RPDO1."""

    def is_set_point(self, frame: Frame) -> bool:
        """Whether it has the drive follow (CiA 402-2, operation enabled): not what stops it."""
        return frame.can_id == self.command_id and self.controlword.of(frame, signed=False) & 0x0F == 0x0F


def pdo_layout(dictionary: ObjectDictionary) -> PdoLayout:
    """Read 1400h, 1800h.. and 1A00h.. (CiA 301, 7.5.2.35 to 7.5.2.38)."""
    each_sync: list[int] = []
    sent: dict[int, Field] = {}
    for number in _PDOS:
        cob_id = int(dictionary.variable(0x1800 + number, 1).read())
        if cob_id & _NOT_VALID:
            continue
        if dictionary.variable(0x1800 + number, 2).read() == 1:
            each_sync.append(cob_id & _COB_ID)
        sent = {**_fields(dictionary, 0x1A00 + number, cob_id & _COB_ID), **sent}
    command_id = int(dictionary.variable(0x1400, 1).read()) & _COB_ID
    return PdoLayout(
        tuple(each_sync),
        sent,
        command_id,
        int(dictionary.variable(0x1400, 2).read()) <= 240,
        _fields(dictionary, 0x1600, command_id)[0x6040],
    )


def _fields(dictionary: ObjectDictionary, mapping: int, can_id: int) -> dict[int, Field]:
    """Index of an object -> its place in the PDO of object ``mapping``."""
    count = int(dictionary.variable(mapping, 0).read())
    words = [int(dictionary.variable(mapping, place + 1).read()) for place in range(count)]
    return fields_of(can_id, [(word >> 16, word & 0xFF) for word in words])


def fields_of(can_id: int, mapped: Iterable[tuple[int, int]]) -> dict[int, Field]:
    """Index of an object -> its place in a PDO of objects and their bits, in this order."""
    fields: dict[int, Field] = {}
    first_bit = 0
    for index, bits in mapped:
        fields.setdefault(index, Field(can_id, first_bit // 8, bits // 8))
        first_bit += bits
    return fields


@dataclass(slots=True)
class DriveLog:
    """What one drive heard."""

    node_id: int
    layout: PdoLayout | None = None
    syncs: list[Heard] = field(default_factory=list)
    """Those that it answered, so none before it was operational."""
    commands: list[HeardCommand] = field(default_factory=list)


@dataclass(slots=True)
class TapLog:
    """Everything that the taps of one segment saw, each list in order of time."""

    handed: list[Passed] = field(default_factory=list)
    """SYNCs and PDOs that the loop handed over and the port took, with the instant of the hand-over: one that
    waits for room in front of the port goes out later."""
    on_bus: list[Passed] = field(default_factory=list)
    """SYNCs and PDOs of everybody, at their end of frame."""
    fetched: list[Passed] = field(default_factory=list)
    """PDOs that the loop was given, in the order in which it fetched them, with the stamps of its port."""
    fetched_syncs: list[Passed] = field(default_factory=list)
    """The same of SYNCs, its own ones that came back among them."""
    drives: dict[int, DriveLog] = field(default_factory=dict)

    def watch(self, segment: CanSegment) -> None:
        """Note every frame on ``segment``."""
        note = self.on_bus.append

        def on_frame(frame: Frame, at: Instant) -> None:
            if frame.can_id == SYNC_ID or frame.can_id in PDO_IDS:
                note(Passed(at, frame))

        segment.add_monitor(on_frame)


class HostTap(FramePort):
    """Stands in front of the loop's port and notes what passes."""

    def __init__(self, inner: FramePort, log: TapLog, now: Callable[[], Instant]) -> None:
        super().__init__()
        self._inner = inner
        self._log = log
        self._now = now
        self.echoes, self.needs_watching, self.troubles = inner.echoes, inner.needs_watching, inner.troubles

    def __getattr__(self, name: str) -> Any:
        """What the bus itself asks of its port."""
        return getattr(self._inner, name)

    def receive(self, until: Instant) -> Frame | None:
        inner = self._inner
        frame = inner.receive(until)
        if frame is None:
            return None
        self.came_at = inner.came_at
        own = getattr(inner, "came_own", None)
        if own is not None:
            self.came_own = own
        if frame.can_id == SYNC_ID:
            self._log.fetched_syncs.append(Passed(inner.came_at, frame))
        elif not own and frame.can_id in PDO_IDS:
            self._log.fetched.append(Passed(inner.came_at, frame))
        return frame

    def transmit(self, frame: Frame) -> None:
        handed_at = self._now() if frame.handed_at == UNTOLD else frame.handed_at
        self._inner.transmit(frame)
        if frame.can_id == SYNC_ID or frame.can_id in PDO_IDS:
            self._log.handed.append(Passed(handed_at, frame))


class DriveTap:
    """Stands in front of a simulated drive, behind whatever befalls its frames, and notes what it hears."""

    def __init__(self, drive: SimulatedServo, log: DriveLog, clock_starts_at_us: int | None) -> None:
        """``clock_starts_at_us``: what 1013h shows at power-on; None: what the drive's seed says."""
        self.clock: DeviceClock = drive.clock
        """The drive's own, which faults step."""
        self._drive = drive
        self._log = log
        self._starts_at_us = clock_starts_at_us
        self._command_id = -1
        self._held: deque[Frame] = deque()
        """SYNCs that the drive has not acted on yet."""

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        answers = self._drive.receive(frame, now)
        can_id = frame.can_id
        if can_id == SYNC_ID:
            if answers:
                self._note_sync(frame, now, answers)
            elif self._drive.state is NmtState.OPERATIONAL:
                self._held.append(frame)
        elif can_id == self._command_id:
            self._log.commands.append(HeardCommand(now, frame, len(self._log.syncs)))
        return answers

    def _note_sync(self, frame: Frame, now: Instant, answers: Sequence[Frame]) -> None:
        log = self._log
        if log.layout is None:
            log.layout = pdo_layout(self._drive.dictionary)
            self._command_id = log.layout.command_id
        log.syncs.append(Heard(now, frame, tuple(answers), self._drive.clock.local_ns(now)))

    def start(self, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        frames = self._drive.start(now)
        if self._starts_at_us is not None:
            self._drive.clock.write(self._starts_at_us)
        return frames

    def wake(self, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        answers = self._drive.wake(now)
        if self._held and answers:
            self._note_late_sync(now, answers)
        return answers

    def _note_late_sync(self, now: Instant, answers: Sequence[Frame]) -> None:
        """The drive acts on SYNCs only now, if what it sends comes with SYNCs: on two that came close by in
        one instant, with one frame of each TPDO for either."""
        if self._drive.state is not NmtState.OPERATIONAL:
            self._held.clear()
            return
        layout = self._log.layout or pdo_layout(self._drive.dictionary)
        first = [place for place, frame in enumerate(answers) if frame.can_id == layout.each_sync[0]]
        for begin, end in pairwise([*first, len(answers)]):
            self._note_sync(self._held.popleft(), now, answers[begin:end])

    @property
    def wake_at(self) -> Instant | None:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        return self._drive.wake_at

    @property
    def node_id(self) -> int:
        """The drive's."""
        return self._drive.node_id

    @property
    def state(self) -> NmtState:
        """The drive's."""
        return self._drive.state

    @property
    def application(self) -> Application:
        """The drive's, which faults fail."""
        return self._drive.application

    def follow_bit_rate(self, set_bit_rate: Callable[[int], None]) -> None:
        """See :class:`servobench.virtual_bus.device.canopen_device.CanopenDevice`."""
        self._drive.follow_bit_rate(set_bit_rate)

    def follow_boot_time(self, boot_time: Callable[[], int]) -> None:
        """See :class:`servobench.virtual_bus.device.canopen_device.CanopenDevice`."""
        self._drive.follow_boot_time(boot_time)

    def answer_scan_in_configuration(self) -> None:
        """See :class:`servobench.virtual_bus.device.canopen_device.CanopenDevice`."""
        self._drive.answer_scan_in_configuration()

    def bus_off(self, now: Instant) -> None:
        """See :class:`servobench.virtual_bus.device.canopen_device.CanopenDevice`."""
        self._drive.bus_off(now)

    def bus_recovered(self, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.device.canopen_device.CanopenDevice`."""
        return self._drive.bus_recovered(now)


def tap_drives(
    drives: Sequence[SimulatedServo], log: TapLog, clock_starts_at_us: int | None = None
) -> list[DriveTap]:
    """``drives`` with a tap before each."""
    taps = []
    for drive in drives:
        own = log.drives[drive.node_id] = DriveLog(drive.node_id)
        taps.append(DriveTap(drive, own, clock_starts_at_us))
    return taps


def stamp_us(heard: Heard, place: Field) -> int | None:
    """1013h in an answer; None if it does not come with this SYNC."""
    for frame in heard.answers:
        if frame.can_id == place.can_id:
            return place.of(frame, signed=False)
    return None
