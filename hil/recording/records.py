"""The packed form of a :class:`CycleRecord`: one row of fixed size, little endian, on every machine.

This is the one place that knows the layout. The ring carries these rows, the digest
hashes them, the summary is computed from them, and ``records.arrow`` holds them by column.
"""

import math
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.exchange import Command, Reading
from drivers.record import values_of
from drivers.timebase import Duration, Instant
from hil.samples import (
    CommandFate,
    CycleRecord,
    Dropout,
    DropoutCause,
    Sample,
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
)
"""Name and struct code of each field, in the order in which the records nest."""

ROW: Final = struct.Struct("<" + "".join(code for _, code in LAYOUT))
_pack_into: Final = ROW.pack_into
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
_FATE_OF: Final = {cause: place for place, cause in enumerate(CAUSES, start=1)}
COMMAND_FATES: tuple[CommandFate, ...] = (
    CommandFate.NOT_MEASURED,
    CommandFate.ACTING,
    CommandFate.LOST,
    CommandFate.NOT_IDENTIFIABLE,
)
"""``command_fate`` is the fate's place here; :data:`NOTHING` for a command that was not sent."""
_NOT_PLACED: Final = (
    *(NOTHING, NOTHING),
    *(math.nan, NOTHING, NOTHING, math.nan, NOTHING, math.nan, NOTHING, NOTHING, NOTHING),
)
_NO_ESTIMATE: Final = (math.nan, math.nan, math.nan, NOTHING, NOTHING)
_NO_COMMAND: Final = (math.nan, NOTHING, NOTHING)
_NO_SENDING: Final = (NOTHING, NOTHING, NOTHING, NOTHING, NOTHING, NOTHING)


def row_fields(record: CycleRecord) -> tuple[object, ...]:
    """The values of ``record`` in the order of :data:`LAYOUT`."""
    observed, command = record.observation, record.command
    placed: tuple[object, ...] = _NOT_PLACED
    if isinstance(observed, Sample):
        fate = FATE_SAMPLE
        placed = (observed.sampled_at, observed.sampled_at_error_ns, *values_of(observed.reading))
    else:
        fate = _FATE_OF[observed.cause]
    fields = (
        *(record.sequence, record.axis, record.due_at),
        *(record.woke_at, record.sync_handed_at, record.sync_on_bus_at),
        *(fate, int(observed.certain), *placed, record.delay),
        *(_NO_ESTIMATE if record.estimate is None else values_of(record.estimate)),
        *(record.reference_rad_s, record.load_torque_nm),
        *(_NO_COMMAND if command is None else values_of(command)[1:]),
        *(_NO_SENDING if record.sending is None else values_of(record.sending)),
        *(record.clock_offset_ns, record.clock_error_ns),
    )
    return tuple([_stored(value) for value in fields])


def _stored(value: object) -> object:
    if isinstance(value, CommandFate):
        return _place_of(value)
    return NOTHING if value is None else value


def _place_of(fate: CommandFate) -> int:
    """In :data:`COMMAND_FATES`; the hash of an enum's member is interpreted."""
    if fate is CommandFate.ACTING:
        return 1
    if fate is CommandFate.NOT_IDENTIFIABLE:
        return 3
    return 2 if fate is CommandFate.LOST else 0


def store_record(memory: Any, place: int, record: CycleRecord) -> None:
    """Pack ``record`` into ``memory`` from byte ``place`` on: the usual ones without :func:`row_fields`."""
    observed, estimate = record.observation, record.estimate
    command, sending = record.command, record.sending
    if not isinstance(observed, Sample) or estimate is None or command is None or sending is None:
        _pack_into(memory, place, *row_fields(record))
        return
    reading = observed.reading
    stamp, on_bus_at, sent_on_bus_at = reading.device_time_ns, record.sync_on_bus_at, sending.on_bus_at
    after, by = sending.acts_after, sending.acts_by
    offset, error = record.clock_offset_ns, record.clock_error_ns
    # fmt: off
    _pack_into(
        memory, place,
        record.sequence, record.axis, record.due_at, record.woke_at, record.sync_handed_at,
        NOTHING if on_bus_at is None else on_bus_at,
        FATE_SAMPLE, observed.certain, observed.sampled_at, observed.sampled_at_error_ns,
        reading.velocity_rad_s, NOTHING if stamp is None else stamp, reading.received_at,
        reading.position_rad, reading.position_told_at, reading.torque_nm, reading.torque_told_at,
        reading.statusword, reading.status_told_at, record.delay,
        estimate.position_rad, estimate.velocity_rad_s, estimate.torque_nm, estimate.valid_at,
        estimate.sequence, record.reference_rad_s, record.load_torque_nm,
        command.torque_nm, command.effective_at, command.expires_at,
        sending.raw, sending.handed_at, NOTHING if sent_on_bus_at is None else sent_on_bus_at,
        _place_of(sending.fate), NOTHING if after is None else after, NOTHING if by is None else by,
        NOTHING if offset is None else offset, NOTHING if error is None else error,
    )
    # fmt: on


def record_of(row: np.void) -> CycleRecord:
    """The record that was packed into ``row``; inverse of :func:`row_fields`."""
    field = {name: row[name].item() for name, _ in LAYOUT}
    return CycleRecord(
        sequence=field["sequence"],
        axis=field["axis"],
        due_at=Instant(field["due_at"]),
        woke_at=_instant(field["woke_at"]),
        sync_handed_at=_instant(field["sync_handed_at"]),
        sync_on_bus_at=_instant(field["sync_on_bus_at"]),
        observation=_observation_of(field),
        delay=_duration(field["delay_ns"]),
        estimate=_estimate_of(field),
        reference_rad_s=field["reference_rad_s"],
        load_torque_nm=field["load_torque_nm"],
        command=_command_of(field),
        sending=_sending_of(field),
        clock_offset_ns=_duration(field["clock_offset_ns"]),
        clock_error_ns=_duration(field["clock_error_ns"]),
    )


def _instant(value: int) -> Instant | None:
    return None if value == NOTHING else Instant(value)


def _duration(value: int) -> Duration | None:
    return None if value == NOTHING else Duration(value)


def _observation_of(field: dict[str, Any]) -> Sample | Dropout:
    sequence, certain = field["sequence"], bool(field["certain"])
    if field["fate"] != FATE_SAMPLE:
        return Dropout(sequence, Instant(field["due_at"]), CAUSES[field["fate"] - 1], certain)
    reading = Reading(
        velocity_rad_s=field["velocity_rad_s"],
        device_time_ns=_duration(field["device_time_ns"]),
        received_at=Instant(field["received_at"]),
        position_rad=field["position_rad"],
        position_told_at=Instant(field["position_told_at"]),
        torque_nm=field["torque_nm"],
        torque_told_at=Instant(field["torque_told_at"]),
        statusword=field["statusword"],
        status_told_at=Instant(field["status_told_at"]),
    )
    at, error_ns = Instant(field["sampled_at"]), field["sampled_at_error_ns"]
    return Sample(sequence, reading, at, error_ns, certain)


def _estimate_of(field: dict[str, Any]) -> StateEstimate | None:
    if field["estimate_sequence"] == NOTHING:
        return None
    return StateEstimate(
        field["estimate_position_rad"],
        field["estimate_velocity_rad_s"],
        field["estimate_torque_nm"],
        Instant(field["estimate_valid_at"]),
        field["estimate_sequence"],
    )


def _command_of(field: dict[str, Any]) -> Command | None:
    if field["command_expires_at"] == NOTHING:
        return None
    return Command(
        field["sequence"],
        field["command_torque_nm"],
        Instant(field["command_effective_at"]),
        Instant(field["command_expires_at"]),
    )


def _sending_of(field: dict[str, Any]) -> Sending | None:
    if field["command_fate"] == NOTHING:
        return None
    return Sending(
        field["command_raw"],
        Instant(field["command_handed_at"]),
        _instant(field["command_on_bus_at"]),
        COMMAND_FATES[field["command_fate"]],
        _instant(field["command_acts_after"]),
        _instant(field["command_acts_by"]),
    )
