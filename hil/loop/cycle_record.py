"""The record of a cycle, and its packed form: one row of fixed size, little endian, on every machine.

A column stands here alone, as one call in :func:`_pack` or below it: its name, unit, meaning and value. The
rows of the ring, the columns of ``records.arrow`` and the documentation's page of columns follow from it. A
value that only the loop has is a field of :class:`CycleRecord` besides, which the axis sets.
"""

import math
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from librt.strings import BytesWriter, write_f64_le, write_i64_le
from mypy_extensions import mypyc_attr

from servobench.drivers.cia402.readings import NEVER_TOLD
from servobench.drivers.exchange import Command, PositionCommand, Reading, SpeedCommand
from servobench.drivers.record import Record
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.context import CHANNELS_MAX
from servobench.hil.loop.samples import (
    AT_REST,
    CommandFate,
    Dropout,
    DropoutCause,
    Observation,
    Sample,
    Sending,
    StateEstimate,
)

NOTHING: Final = -(2**63)
"""Represents None: no instant of any clock, no delay and no count has this value."""

Codes = tuple[str, ...]
"""Meanings of a column's numbers, from 0 on."""

FATE_SAMPLE: Final = 0
CAUSES: tuple[DropoutCause, ...] = (
    DropoutCause.LOST,
    DropoutCause.LATE,
    DropoutCause.STALE,
    DropoutCause.MISSED,
)
"""``fate`` of a dropout is its cause's place here, counted from 1."""
FATE_MISSED: Final = 1 + CAUSES.index(DropoutCause.MISSED)
_FATES: Codes = ("sample", *[cause.value for cause in CAUSES])
COMMAND_FATES: tuple[CommandFate, ...] = (
    CommandFate.NOT_MEASURED,
    CommandFate.ACTING,
    CommandFate.LOST,
    CommandFate.NOT_IDENTIFIABLE,
    CommandFate.NOT_FOLLOWED,
    CommandFate.NOT_SENT,
)
"""``command_fate`` is the fate's place here; :data:`NOTHING` for a command that was not sent."""
_COMMAND_FATES: Codes = tuple([fate.value for fate in COMMAND_FATES])

RUN_TIME: Final = "ns since the first cycle"
_CHANNELS: tuple[str, ...] = tuple([f"channel_{number}" for number in range(CHANNELS_MAX)])
_CHANNEL_MEANINGS: tuple[str, ...] = tuple(
    [f"what the controller told as number {number} of its channels" for number in range(CHANNELS_MAX)]
)


@mypyc_attr(free_list_len=1)
class CycleRecord(Record):
    """Everything about one planned cycle of one axis: what came of its SYNC, and what was done in it.

    Each field is set once, by its name, right after it was made.
    """

    sequence: int
    axis: int
    due_at: Instant
    woke_at: Instant | None
    sync_handed_at: Instant | None
    sync_on_bus_at: Instant | None
    observation: Observation
    """The fate of this cycle's own reading."""
    delay: Duration | None
    estimate: StateEstimate | None
    """None, like all that follows but reference and load, where nothing was decided."""
    reference_rad_s: float
    load_torque_nm: float
    command: Command | None
    sending: Sending | None
    """None if the command was not sent."""
    clock_offset_ns: int | None
    """None for a drive without a clock, as the error."""
    clock_error_ns: int | None
    compute_ns: int | None = None
    channels: Sequence[float] = ()
    """What the controller told of its own, by its ``channels``."""
    reference_rad: float | None = None
    reference_nm: float | None = None


class Column(NamedTuple):
    """One field of a row, and of ``records.arrow``."""

    name: str
    kind: str
    """Arrow's name of its type. In a packed row each field has eight bytes, a real or a whole number."""
    unit: str
    """Empty for a plain number."""
    meaning: str
    codes: Codes = ()
    none: int = NOTHING
    """A further value for nothing in a packed row, in addition to NOTHING."""

    @property
    def is_instant(self) -> bool:
        """True if it counts from the first cycle, and in a packed row from the bench clock's origin."""
        return self.unit == RUN_TIME

    @property
    def is_real(self) -> bool:
        """True for a real number, which is NaN in a packed row if missing."""
        return self.kind == "float64"


class PackedRow:
    """A row in the making: each call writes one column, and describes it."""

    def __init__(self, columns: list[Column] | None = None) -> None:
        """``columns``: gets the descriptions; None: nobody asks for them."""
        self.bytes = BytesWriter()
        self._columns = columns

    def whole(
        self, name: str, unit: str, meaning: str, value: int, kind: str = "int64", codes: Codes = ()
    ) -> None:
        """Write a whole number."""
        write_i64_le(self.bytes, value)
        if self._columns is not None:
            self._columns.append(Column(name, kind, unit, meaning, codes))

    def whole_if(self, name: str, unit: str, meaning: str, value: int | None) -> None:
        """Write a whole number, if there is one."""
        write_i64_le(self.bytes, NOTHING if value is None else value)
        if self._columns is not None:
            self._columns.append(Column(name, "int64", unit, meaning))

    def instant(self, name: str, meaning: str, value: int) -> None:
        """Write an instant."""
        self.whole(name, RUN_TIME, meaning, value)

    def instant_if(self, name: str, meaning: str, value: int | None) -> None:
        """Write an instant, if there is one."""
        self.whole_if(name, RUN_TIME, meaning, value)

    def told(self, name: str, unit: str, meaning: str, value: int) -> None:
        """Write a number that a reading may lack: NEVER_TOLD."""
        write_i64_le(self.bytes, value)
        if self._columns is not None:
            self._columns.append(Column(name, "int64", unit, meaning, none=NEVER_TOLD))

    def real(self, name: str, unit: str, meaning: str, value: float) -> None:
        """Write a real number; NaN: there is none."""
        write_f64_le(self.bytes, value)
        if self._columns is not None:
            self._columns.append(Column(name, "float64", unit, meaning))

    def real_if(self, name: str, unit: str, meaning: str, value: float | None) -> None:
        """Write a real number, if there is one."""
        self.real(name, unit, meaning, math.nan if value is None else value)


def row_of(record: CycleRecord) -> bytes:
    """Pack ``record``: eight bytes for each of :data:`COLUMNS`."""
    row = PackedRow()
    _pack(row, record)
    return row.bytes.getvalue()


def _pack(row: PackedRow, record: CycleRecord) -> None:
    """Write all columns, in the order in which the records nest."""
    row.whole("sequence", "", "number of the planned cycle, from 1", record.sequence)
    row.whole("axis", "", "place of the axis in the list 'axes' of the file's metadata", record.axis, "int16")
    row.instant("due_at", "the tick of the cycle", record.due_at)
    row.instant_if("woke_at", "when the host came for it; null if it did not", record.woke_at)
    handed = "when its SYNC was handed to the bus; null without SYNC"
    row.instant_if("sync_handed_at", handed, record.sync_handed_at)
    on_bus = "end of its SYNC on the bus; null if it is not known to have come there"
    row.instant_if("sync_on_bus_at", on_bus, record.sync_on_bus_at)
    _pack_observation(row, record.observation)
    row.whole_if(
        "delay_ns", "ns", "sampled to received, of late readings too; null if none came", record.delay
    )
    _pack_estimate(row, record.estimate)
    asked = "speed that was asked for; of a position its rate, null of a torque"
    row.real("reference_rad_s", "rad/s", asked, record.reference_rad_s)
    load = "load that was asked for; positive opposes positive speed"
    row.real("load_torque_nm", "N m", load, record.load_torque_nm)
    _pack_command(row, record.command)
    _pack_sending(row, record.sending)
    offset = "run time minus the drive's clock, by the map of that clock"
    row.instant_if("clock_offset_ns", offset, record.clock_offset_ns)
    row.whole_if("clock_error_ns", "ns", "error of an instant that this map places", record.clock_error_ns)
    taken = "what compensator and controller took, by the host's own clock"
    row.whole_if("compute_ns", "ns", taken, record.compute_ns)
    _pack_channels(row, record.channels)
    position = "position that was asked for; null of another reference"
    row.real_if("reference_position_rad", "rad", position, record.reference_rad)
    torque = "torque that was asked for; null of another reference"
    row.real_if("reference_torque_nm", "N m", torque, record.reference_nm)
    _pack_other_command(row, record.command)


def _pack_observation(row: PackedRow, observed: Observation) -> None:
    fate = FATE_SAMPLE if isinstance(observed, Sample) else _fate_of(observed.cause)
    row.whole("fate", "", "what came of its reading", fate, "int8", _FATES)
    certain = "whether the data decide which SYNC the reading answers"
    row.whole("certain", "", certain, int(observed.certain), "bool")
    if isinstance(observed, Dropout):
        row.bytes.write(_NO_SAMPLE)
        return
    at = "end of that SYNC at the drive; null for a dropout, as all of the reading"
    row.instant("sampled_at", at, observed.sampled_at)
    error = "half the width of the interval that holds sampled_at"
    row.whole("sampled_at_error_ns", "ns", error, observed.sampled_at_error_ns)
    reading = observed.reading
    row.real("velocity_rad_s", "rad/s", "measured speed", reading.velocity_rad_s)
    stamp, on_drive = "the drive's own stamp of the sample", "ns on the drive's clock"
    row.whole_if("device_time_ns", on_drive, stamp, reading.device_time_ns)
    row.instant("received_at", "bus stamp of the frame that carries the speed", reading.received_at)
    carried = "position, carried on by the speed since it was told"
    row.real("position_rad", "rad", carried, reading.position_rad)
    at = "bus stamp of the frame that told the position"
    row.told("position_told_at", RUN_TIME, at, reading.position_told_at)
    row.real("torque_nm", "N m", "measured torque as last told", reading.torque_nm)
    at = "bus stamp of the frame that told the torque"
    row.told("torque_told_at", RUN_TIME, at, reading.torque_told_at)
    row.told("statusword", "", "object 6041h as last told", reading.statusword)
    at = "bus stamp of the frame that told the statusword"
    row.told("status_told_at", RUN_TIME, at, reading.status_told_at)


def _pack_estimate(row: PackedRow, estimate: StateEstimate | None) -> None:
    if estimate is None:
        row.bytes.write(_NO_ESTIMATE)
        return
    given = "the state that the controller was given"
    row.real("estimate_position_rad", "rad", given, estimate.position_rad)
    row.real("estimate_velocity_rad_s", "rad/s", given, estimate.velocity_rad_s)
    row.real("estimate_torque_nm", "N m", given, estimate.torque_nm)
    row.instant("estimate_valid_at", "for when that state holds", estimate.valid_at)
    rests_on = "cycle of the sample that it rests on; 0 before the first"
    row.whole("estimate_sequence", "", rests_on, estimate.sequence)


def _pack_command(row: PackedRow, command: Command | None) -> None:
    if command is None:
        row.bytes.write(_NO_COMMAND)
        return
    row.real("command_torque_nm", "N m", "torque set-point, after the limits", command.torque_nm)
    row.instant("command_effective_at", "when it was meant to act", command.effective_at)
    row.instant("command_expires_at", "when it was worth nothing any more", command.expires_at)


def _pack_other_command(row: PackedRow, command: Command | None) -> None:
    """Write a speed or position command."""
    speed = command.speed_rad_s if isinstance(command, SpeedCommand) else math.nan
    meaning = "speed set-point, after the limits; null of another command"
    row.real("command_speed_rad_s", "rad/s", meaning, speed)
    position = command.position_rad if isinstance(command, PositionCommand) else math.nan
    meaning = "position set-point, after the limits; null of another command"
    row.real("command_position_rad", "rad", meaning, position)


def _pack_sending(row: PackedRow, sending: Sending | None) -> None:
    if sending is None:
        row.bytes.write(_NO_SENDING)
        return
    row.whole("command_raw", "the unit of 6071h, 60FFh or 607Ah", "the set-point as it was sent", sending.raw)
    at = "when it was handed to the bus; null if it was not sent"
    row.instant("command_handed_at", at, sending.handed_at)
    at = "end of its frame on the bus; null if that is not known"
    row.instant_if("command_on_bus_at", at, sending.on_bus_at)
    became = "what became of the command behind the bus"
    row.whole("command_fate", "", became, _place_of(sending.fate), "int8", _COMMAND_FATES)
    at = "the latest instant known at which it did not act yet"
    row.instant_if("command_acts_after", at, sending.acts_after)
    row.instant_if("command_acts_by", "the earliest instant known at which it acted", sending.acts_by)


def _pack_channels(row: PackedRow, channels: Sequence[float]) -> None:
    told = len(channels)
    for place in range(CHANNELS_MAX):
        value = channels[place] if place < told else math.nan
        row.real(_CHANNELS[place], "", _CHANNEL_MEANINGS[place], value)


def _fate_of(cause: DropoutCause) -> int:
    """Return its place in :data:`CAUSES`, counted from 1."""
    return 1 + CAUSES.index(cause)


def _place_of(fate: CommandFate) -> int:
    """Return its place in :data:`COMMAND_FATES`; hashing an enum member is interpreted."""
    if fate is CommandFate.ACTING:
        return 1
    if fate is CommandFate.NOT_IDENTIFIABLE:
        return 3
    if fate is CommandFate.NOT_FOLLOWED:
        return 4
    if fate is CommandFate.NOT_SENT:
        return 5
    return 2 if fate is CommandFate.LOST else 0


def _described() -> list[Column]:
    """Return the columns of a record that lacks nothing."""
    whole = CycleRecord()
    whole.sequence = whole.axis = 0
    whole.due_at = Instant(0)
    whole.woke_at = whole.sync_handed_at = whole.sync_on_bus_at = None
    reading = Reading(0.0, None, Instant(0), 0.0, Instant(0), 0.0, Instant(0), 0, Instant(0))
    whole.observation = Sample(0, reading, Instant(0), 0, certain=True)
    whole.delay, whole.estimate = None, AT_REST
    whole.reference_rad_s = whole.load_torque_nm = 0.0
    whole.command = Command(0, 0.0, Instant(0), Instant(0))
    whole.sending = Sending(0, Instant(0), None, CommandFate.ACTING, None, None)
    whole.clock_offset_ns = whole.clock_error_ns = None
    columns: list[Column] = []
    _pack(PackedRow(columns), whole)
    return columns


COLUMNS: tuple[Column, ...] = tuple(_described())
NAMES: tuple[str, ...] = tuple([column.name for column in COLUMNS])
ROW: Final = struct.Struct("<" + "".join(["d" if column.is_real else "q" for column in COLUMNS]))
_NOTHINGS: Final = ROW.pack(*[math.nan if column.is_real else NOTHING for column in COLUMNS])


def _nothing(first: str, behind: str) -> bytes:
    """Return the columns from ``first`` up to the one before ``behind``, all missing."""
    return _NOTHINGS[8 * NAMES.index(first) : 8 * NAMES.index(behind)]


_NO_SAMPLE: Final = _nothing("sampled_at", "delay_ns")
_NO_ESTIMATE: Final = _nothing("estimate_position_rad", "reference_rad_s")
_NO_COMMAND: Final = _nothing("command_torque_nm", "command_raw")
_NO_SENDING: Final = _nothing("command_raw", "clock_offset_ns")
