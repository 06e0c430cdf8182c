"""The record of a cycle, and its packed form: one row of fixed size, little endian, on every machine.

A column is named and described in :data:`COLUMNS`, and written at the same place of :func:`row_of`; a value
that only the loop has is a field of :class:`CycleRecord` besides, which the axis sets. The rows of the ring,
the columns of ``records.arrow`` and the documentation's page of columns follow.
"""

import math
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from librt.strings import BytesWriter, write_f64_le, write_i64_le
from mypy_extensions import mypyc_attr

from servobench.drivers.exchange import NEVER_TOLD, Command, PositionCommand, SpeedCommand
from servobench.drivers.record import Record
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.protocol import CHANNELS_MAX
from servobench.hil.loop.samples import (
    CommandFate,
    Dropout,
    DropoutCause,
    Observation,
    Sending,
    StateEstimate,
)

NOTHING: Final = -(2**63)
"""Represents None: no instant of any clock, no delay and no count has this value."""

FATE_SAMPLE: Final = 0
CAUSES: tuple[DropoutCause, ...] = (
    DropoutCause.LOST,
    DropoutCause.LATE,
    DropoutCause.STALE,
    DropoutCause.MISSED,
)
"""``fate`` of a dropout is its cause's place here, counted from 1."""
FATE_MISSED: Final = 1 + CAUSES.index(DropoutCause.MISSED)
COMMAND_FATES: tuple[CommandFate, ...] = (
    CommandFate.NOT_MEASURED,
    CommandFate.ACTING,
    CommandFate.LOST,
    CommandFate.NOT_IDENTIFIABLE,
    CommandFate.NOT_FOLLOWED,
    CommandFate.NOT_SENT,
)
"""``command_fate`` is the fate's place here; :data:`NOTHING` for a command that was not sent."""

RUN_TIME: Final = "ns since the first cycle"


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
    """Values that the controller told of its own, by its ``channels``."""
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
    codes: tuple[str, ...] = ()
    """Meanings of its numbers, from 0 on."""
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


def _instant(name: str, meaning: str, none: int = NOTHING) -> Column:
    return Column(name, "int64", RUN_TIME, meaning, none=none)


def _number(name: str, unit: str, meaning: str) -> Column:
    return Column(name, "float64", unit, meaning)


COLUMNS: tuple[Column, ...] = (
    # CycleRecord
    Column("sequence", "int64", "", "number of the planned cycle, from 1"),
    Column("axis", "int16", "", "place of the axis in the list 'axes' of the file's metadata"),
    _instant("due_at", "the tick of the cycle"),
    _instant("woke_at", "when the host came for it; null if it did not"),
    _instant("sync_handed_at", "when its SYNC was handed to the bus; null without SYNC"),
    _instant("sync_on_bus_at", "end of its SYNC on the bus; null if it is not known to have come there"),
    # its observation
    Column(
        "fate",
        "int8",
        "",
        "what came of its reading",
        ("sample", *[cause.value for cause in CAUSES]),
    ),
    Column("certain", "bool", "", "whether the data decide which SYNC the reading answers"),
    _instant("sampled_at", "end of that SYNC at the drive; null for a dropout, as all of the reading"),
    Column("sampled_at_error_ns", "int64", "ns", "half the width of the interval that holds sampled_at"),
    # the reading of a Sample
    _number("velocity_rad_s", "rad/s", "measured speed"),
    Column("device_time_ns", "int64", "ns on the drive's clock", "the drive's own stamp of the sample"),
    _instant("received_at", "bus stamp of the frame that carries the speed"),
    _number("position_rad", "rad", "position, carried on by the speed since it was told"),
    _instant("position_told_at", "bus stamp of the frame that told the position", NEVER_TOLD),
    _number("torque_nm", "N m", "measured torque as last told"),
    _instant("torque_told_at", "bus stamp of the frame that told the torque", NEVER_TOLD),
    Column("statusword", "int64", "", "object 6041h as last told", none=NEVER_TOLD),
    _instant("status_told_at", "bus stamp of the frame that told the statusword", NEVER_TOLD),
    # CycleRecord
    Column("delay_ns", "int64", "ns", "sampled to received, of late readings too; null if none came"),
    # its estimate
    _number("estimate_position_rad", "rad", "the state that the controller was given"),
    _number("estimate_velocity_rad_s", "rad/s", "the state that the controller was given"),
    _number("estimate_torque_nm", "N m", "the state that the controller was given"),
    _instant("estimate_valid_at", "for when that state holds"),
    Column("estimate_sequence", "int64", "", "cycle of the sample that it rests on; 0 before the first"),
    # CycleRecord
    _number("reference_rad_s", "rad/s", "speed that was asked for; of a position its rate, null of a torque"),
    _number("load_torque_nm", "N m", "load that was asked for; positive opposes positive speed"),
    # its command
    _number("command_torque_nm", "N m", "torque set-point, after the limits"),
    _instant("command_effective_at", "when it was meant to act"),
    _instant("command_expires_at", "when it was worth nothing any more"),
    # the way of it
    Column("command_raw", "int64", "the unit of 6071h, 60FFh or 607Ah", "the set-point as it was sent"),
    _instant("command_handed_at", "when it was handed to the bus; null if it was not sent"),
    _instant("command_on_bus_at", "end of its frame on the bus; null if that is not known"),
    Column(
        "command_fate",
        "int8",
        "",
        "what became of the command behind the bus",
        tuple(fate.value for fate in COMMAND_FATES),
    ),
    _instant("command_acts_after", "the latest instant known at which it did not act yet"),
    _instant("command_acts_by", "the earliest instant known at which it acted"),
    # CycleRecord
    _instant("clock_offset_ns", "run time minus the drive's clock, by the map of that clock"),
    Column("clock_error_ns", "int64", "ns", "error of an instant that this map places"),
    Column("compute_ns", "int64", "ns", "what compensator and controller took, by the host's own clock"),
    # of its channels
    *(
        _number(f"channel_{number}", "", f"what the controller told as number {number} of its channels")
        for number in range(CHANNELS_MAX)
    ),
    # CycleRecord, of a reference that is no speed
    _number("reference_position_rad", "rad", "position that was asked for; null of another reference"),
    _number("reference_torque_nm", "N m", "torque that was asked for; null of another reference"),
    # its command, where that is no torque
    _number("command_speed_rad_s", "rad/s", "speed set-point, after the limits; null of another command"),
    _number("command_position_rad", "rad", "position set-point, after the limits; null of another command"),
)
"""In the order in which the records nest."""

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


def row_of(record: CycleRecord) -> bytes:
    """Pack ``record`` into ROW.size bytes."""
    row = BytesWriter()
    write_i64_le(row, record.sequence)
    write_i64_le(row, record.axis)
    write_i64_le(row, record.due_at)
    _write(row, record.woke_at)
    _write(row, record.sync_handed_at)
    _write(row, record.sync_on_bus_at)
    _write_observation(row, record.observation)
    _write(row, record.delay)
    _write_estimate(row, record.estimate)
    write_f64_le(row, record.reference_rad_s)
    write_f64_le(row, record.load_torque_nm)
    _write_command(row, record.command)
    _write_sending(row, record.sending)
    _write(row, record.clock_offset_ns)
    _write(row, record.clock_error_ns)
    _write(row, record.compute_ns)
    _write_channels(row, record.channels)
    write_f64_le(row, math.nan if record.reference_rad is None else record.reference_rad)
    write_f64_le(row, math.nan if record.reference_nm is None else record.reference_nm)
    _write_other_command(row, record.command)
    return row.getvalue()


def _write(row: BytesWriter, value: int | None) -> None:
    write_i64_le(row, NOTHING if value is None else value)


def _write_observation(row: BytesWriter, observed: Observation) -> None:
    if isinstance(observed, Dropout):
        write_i64_le(row, _fate_of(observed.cause))
        write_i64_le(row, int(observed.certain))
        row.write(_NO_SAMPLE)
        return
    reading = observed.reading
    write_i64_le(row, FATE_SAMPLE)
    write_i64_le(row, int(observed.certain))
    write_i64_le(row, observed.sampled_at)
    write_i64_le(row, observed.sampled_at_error_ns)
    write_f64_le(row, reading.velocity_rad_s)
    _write(row, reading.device_time_ns)
    write_i64_le(row, reading.received_at)
    write_f64_le(row, reading.position_rad)
    write_i64_le(row, reading.position_told_at)
    write_f64_le(row, reading.torque_nm)
    write_i64_le(row, reading.torque_told_at)
    write_i64_le(row, reading.statusword)
    write_i64_le(row, reading.status_told_at)


def _write_estimate(row: BytesWriter, estimate: StateEstimate | None) -> None:
    if estimate is None:
        row.write(_NO_ESTIMATE)
        return
    write_f64_le(row, estimate.position_rad)
    write_f64_le(row, estimate.velocity_rad_s)
    write_f64_le(row, estimate.torque_nm)
    write_i64_le(row, estimate.valid_at)
    write_i64_le(row, estimate.sequence)


def _write_command(row: BytesWriter, command: Command | None) -> None:
    if command is None:
        row.write(_NO_COMMAND)
        return
    write_f64_le(row, command.torque_nm)
    write_i64_le(row, command.effective_at)
    write_i64_le(row, command.expires_at)


def _write_other_command(row: BytesWriter, command: Command | None) -> None:
    """Write a speed or position command."""
    write_f64_le(row, command.speed_rad_s if isinstance(command, SpeedCommand) else math.nan)
    write_f64_le(row, command.position_rad if isinstance(command, PositionCommand) else math.nan)


def _write_sending(row: BytesWriter, sending: Sending | None) -> None:
    if sending is None:
        row.write(_NO_SENDING)
        return
    write_i64_le(row, sending.raw)
    write_i64_le(row, sending.handed_at)
    _write(row, sending.on_bus_at)
    write_i64_le(row, _place_of(sending.fate))
    _write(row, sending.acts_after)
    _write(row, sending.acts_by)


def _write_channels(row: BytesWriter, channels: Sequence[float]) -> None:
    told = len(channels)
    for place in range(CHANNELS_MAX):
        write_f64_le(row, channels[place] if place < told else math.nan)


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
