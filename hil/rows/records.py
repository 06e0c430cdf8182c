"""The packed form of a :class:`CycleRecord`: one row of fixed size, little endian, on every machine.

This is the one place that knows the layout. The ring carries these rows, the digest
hashes them, the summary is computed from them, and ``records.arrow`` holds them by column.
"""

import math
import struct
from collections.abc import Sequence
from typing import Final

import numpy as np
from librt.strings import BytesWriter, write_f64_le, write_i64_le
from numpy.typing import NDArray

from drivers.exchange import Command, PositionCommand, SpeedCommand
from hil.loop.context import CHANNELS_MAX
from hil.loop.samples import (
    CommandFate,
    CycleRecord,
    Dropout,
    DropoutCause,
    Observation,
    Sending,
    StateEstimate,
)

LAYOUT: tuple[tuple[str, str], ...] = (
    # CycleRecord
    ("sequence", "q"),
    ("axis", "q"),
    ("due_at", "q"),
    ("woke_at", "q"),
    ("sync_handed_at", "q"),
    ("sync_on_bus_at", "q"),
    # its observation
    ("fate", "q"),
    ("certain", "q"),
    ("sampled_at", "q"),
    ("sampled_at_error_ns", "q"),
    # the reading of a Sample
    ("velocity_rad_s", "d"),
    ("device_time_ns", "q"),
    ("received_at", "q"),
    ("position_rad", "d"),
    ("position_told_at", "q"),
    ("torque_nm", "d"),
    ("torque_told_at", "q"),
    ("statusword", "q"),
    ("status_told_at", "q"),
    # CycleRecord
    ("delay_ns", "q"),
    # its estimate
    ("estimate_position_rad", "d"),
    ("estimate_velocity_rad_s", "d"),
    ("estimate_torque_nm", "d"),
    ("estimate_valid_at", "q"),
    ("estimate_sequence", "q"),
    # CycleRecord
    ("reference_rad_s", "d"),
    ("load_torque_nm", "d"),
    # its command
    ("command_torque_nm", "d"),
    ("command_effective_at", "q"),
    ("command_expires_at", "q"),
    # the way of it
    ("command_raw", "q"),
    ("command_handed_at", "q"),
    ("command_on_bus_at", "q"),
    ("command_fate", "q"),
    ("command_acts_after", "q"),
    ("command_acts_by", "q"),
    # CycleRecord
    ("clock_offset_ns", "q"),
    ("clock_error_ns", "q"),
    ("compute_ns", "q"),
    # of its channels
    *((f"channel_{number}", "d") for number in range(CHANNELS_MAX)),
    # CycleRecord, of a reference that is no speed
    ("reference_position_rad", "d"),
    ("reference_torque_nm", "d"),
    # its command, where that is no torque
    ("command_speed_rad_s", "d"),
    ("command_position_rad", "d"),
)
"""Name and struct code of each field, in the order in which the records nest."""

DIGESTED_BYTES: Final = 8 * [name for name, _ in LAYOUT].index("compute_ns")
"""Of each row, from its beginning: in simulated time that follows from the bench file and the seed. A
reference or a command that is no speed and no torque lies behind, but what of it came to the drive and back,
``command_raw`` and the reading, lies within."""

ROW: Final = struct.Struct("<" + "".join(code for _, code in LAYOUT))
_NUMPY: Final = {"q": "<i8", "d": "<f8"}
ROW_DTYPE: Final = np.dtype([(name, _NUMPY[code]) for name, code in LAYOUT])
"""The same row for numpy. A real number that there is none of is NaN, a whole number :data:`NOTHING`."""

Rows = NDArray[np.void]
"""(n,) of ROW_DTYPE."""

NOTHING: Final = -(2**63)
"""Stands for None: no instant of any clock, no delay and no count is that."""

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
)
"""``command_fate`` is the fate's place here; :data:`NOTHING` for a command that was not sent."""


def row_of(record: CycleRecord) -> bytes:
    """``record`` packed, ROW.size bytes."""
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
        _write_none(row, "qqdqqdqdqqq")
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
        _write_none(row, "dddqq")
        return
    write_f64_le(row, estimate.position_rad)
    write_f64_le(row, estimate.velocity_rad_s)
    write_f64_le(row, estimate.torque_nm)
    write_i64_le(row, estimate.valid_at)
    write_i64_le(row, estimate.sequence)


def _write_command(row: BytesWriter, command: Command | None) -> None:
    if command is None:
        _write_none(row, "dqq")
        return
    write_f64_le(row, command.torque_nm)
    write_i64_le(row, command.effective_at)
    write_i64_le(row, command.expires_at)


def _write_other_command(row: BytesWriter, command: Command | None) -> None:
    """Of a speed or of a position."""
    write_f64_le(row, command.speed_rad_s if isinstance(command, SpeedCommand) else math.nan)
    write_f64_le(row, command.position_rad if isinstance(command, PositionCommand) else math.nan)


def _write_sending(row: BytesWriter, sending: Sending | None) -> None:
    if sending is None:
        _write_none(row, "qqqqqq")
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


def _write_none(row: BytesWriter, codes: str) -> None:
    """Fields that there is nothing for."""
    for code in codes:
        if code == "d":
            write_f64_le(row, math.nan)
        else:
            write_i64_le(row, NOTHING)


def _fate_of(cause: DropoutCause) -> int:
    """In :data:`CAUSES`, counted from 1."""
    return 1 + CAUSES.index(cause)


def _place_of(fate: CommandFate) -> int:
    """In :data:`COMMAND_FATES`; the hash of an enum's member is interpreted."""
    if fate is CommandFate.ACTING:
        return 1
    if fate is CommandFate.NOT_IDENTIFIABLE:
        return 3
    return 2 if fate is CommandFate.LOST else 0
