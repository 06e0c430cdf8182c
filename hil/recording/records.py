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
from drivers.timebase import Duration, Instant
from hil.samples import CycleRecord, Dropout, DropoutCause, Sample, StateEstimate

LAYOUT: tuple[tuple[str, str], ...] = (
    # CycleRecord
    ("sequence", "q"),
    ("axis", "q"),
    ("due_at", "q"),
    ("woke_at", "q"),
    ("sync_sent_at", "q"),
    # its observation
    ("fate", "q"),
    ("observation_sequence", "q"),
    ("observation_at", "q"),  # sampled_at of a Sample, due_at of a Dropout
    ("sampled_at_error_ns", "q"),
    # the reading of a Sample
    ("reading_sequence", "q"),
    ("position_rad", "d"),
    ("velocity_rad_s", "d"),
    ("torque_nm", "d"),
    ("statusword", "q"),
    ("device_time_ns", "q"),
    ("received_at", "q"),
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
    ("command_sequence", "q"),
    ("command_torque_nm", "d"),
    ("command_effective_at", "q"),
    ("command_expires_at", "q"),
    # CycleRecord
    ("command_sent_at", "q"),
)
"""Name and struct code of each field, in the order in which the named tuples nest."""

ROW: Final = struct.Struct("<" + "".join(code for _, code in LAYOUT))
_pack_into: Final = ROW.pack_into
_NUMPY: Final = {"q": "<i8", "d": "<f8"}
ROW_DTYPE: Final = np.dtype([(name, _NUMPY[code]) for name, code in LAYOUT])
"""The same row for numpy. Fields of a reading that never came are NaN, -1 and statusword 0."""

Rows = NDArray[np.void]
"""(n,) of ROW_DTYPE."""

NO_TIME: Final = -(2**63)
"""``device_time_ns`` of a drive without a clock: no instant of any clock."""

FATE_SAMPLE: Final = 0
CAUSES: tuple[DropoutCause, ...] = (DropoutCause.LOST, DropoutCause.LATE, DropoutCause.STALE)
"""``fate`` of a dropout is its cause's place here, counted from 1."""
_FATE_OF: Final = {cause: place for place, cause in enumerate(CAUSES, start=1)}
_NO_READING: Final = (-1, math.nan, math.nan, math.nan, 0, NO_TIME, Instant(-1))


def row_fields(record: CycleRecord) -> tuple[object, ...]:
    """The values of ``record`` in the order of :data:`LAYOUT`."""
    # Unpacking whole tuples costs half of naming each field; this runs in every cycle.
    sequence, axis, due_at, woke_at, sync_at, observed, delay, estimate, aim, load, command, sent_at = record
    if isinstance(observed, Sample):
        place, reading, observed_at, error = observed
        fate = FATE_SAMPLE
        answered, position, velocity, torque, status, device_time, received_at = reading
        if device_time is None:
            device_time = NO_TIME
    else:
        place, observed_at, cause = observed
        fate, error = _FATE_OF[cause], -1
        answered, position, velocity, torque, status, device_time, received_at = _NO_READING
    at_rad, at_rad_s, at_nm, valid_at, rests_on = estimate
    asked, torque_nm, effective_at, expires_at = command
    # fmt: off
    return (
        sequence, axis, due_at, woke_at, sync_at, fate, place, observed_at, error,
        answered, position, velocity, torque, status, device_time, received_at,
        delay, at_rad, at_rad_s, at_nm, valid_at, rests_on, aim, load,
        asked, torque_nm, effective_at, expires_at, sent_at,
    )
    # fmt: on


def store_record(memory: Any, place: int, record: CycleRecord) -> None:
    """Pack ``record`` into ``memory`` from byte ``place`` on: :func:`row_fields` without the tuple."""
    sequence, axis, due_at, woke_at, sync_at, observed, delay, estimate, aim, load, command, sent_at = record
    if not isinstance(observed, Sample):
        ROW.pack_into(memory, place, *row_fields(record))
        return
    matched, reading, sampled_at, error = observed
    answered, position, velocity, torque, status, device_time, received_at = reading
    if device_time is None:
        device_time = NO_TIME
    at_rad, at_rad_s, at_nm, valid_at, rests_on = estimate
    asked, torque_nm, effective_at, expires_at = command
    # fmt: off
    _pack_into(
        memory, place,
        sequence, axis, due_at, woke_at, sync_at, FATE_SAMPLE, matched, sampled_at, error,
        answered, position, velocity, torque, status, device_time, received_at,
        delay, at_rad, at_rad_s, at_nm, valid_at, rests_on, aim, load,
        asked, torque_nm, effective_at, expires_at, sent_at,
    )
    # fmt: on


def record_of(row: np.void) -> CycleRecord:
    """The record that was packed into ``row``; inverse of :func:`row_fields`."""
    field = {name: row[name].item() for name, _ in LAYOUT}
    return CycleRecord(
        sequence=field["sequence"],
        axis=field["axis"],
        due_at=Instant(field["due_at"]),
        woke_at=Instant(field["woke_at"]),
        sync_sent_at=Instant(field["sync_sent_at"]),
        observation=_observation_of(field),
        delay=Duration(field["delay_ns"]),
        estimate=StateEstimate(
            field["estimate_position_rad"],
            field["estimate_velocity_rad_s"],
            field["estimate_torque_nm"],
            Instant(field["estimate_valid_at"]),
            field["estimate_sequence"],
        ),
        reference_rad_s=field["reference_rad_s"],
        load_torque_nm=field["load_torque_nm"],
        command=Command(
            field["command_sequence"],
            field["command_torque_nm"],
            Instant(field["command_effective_at"]),
            Instant(field["command_expires_at"]),
        ),
        command_sent_at=Instant(field["command_sent_at"]),
    )


def _observation_of(field: dict[str, int | float]) -> Sample | Dropout:
    sequence, observed_at = int(field["observation_sequence"]), Instant(int(field["observation_at"]))
    if field["fate"] != FATE_SAMPLE:
        return Dropout(sequence, observed_at, CAUSES[int(field["fate"]) - 1])
    device_time = int(field["device_time_ns"])
    reading = Reading(
        sequence=int(field["reading_sequence"]),
        position_rad=field["position_rad"],
        velocity_rad_s=field["velocity_rad_s"],
        torque_nm=field["torque_nm"],
        statusword=int(field["statusword"]),
        device_time_ns=None if device_time == NO_TIME else device_time,
        received_at=Instant(int(field["received_at"])),
    )
    return Sample(sequence, reading, observed_at, int(field["sampled_at_error_ns"]))
