"""Rows for tests: from records, or from a few columns; and the records in them."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from servobench.drivers.exchange import Command, Reading
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.cycle_record import (
    CAUSES,
    COMMAND_FATES,
    FATE_SAMPLE,
    NAMES,
    NOTHING,
    CycleRecord,
    row_of,
)
from servobench.hil.loop.protocol import CHANNELS_MAX
from servobench.hil.loop.samples import Dropout, Sample, Sending, StateEstimate
from servobench.hil.rows.records import ROW_DTYPE, Rows


def cycle_record(**fields: Any) -> CycleRecord:
    """A record with these fields, and those that have a default."""
    made = CycleRecord()
    for name, value in fields.items():
        setattr(made, name, value)
    return made


def rows_of(records: Iterable[CycleRecord]) -> Rows:
    """Packed records."""
    return np.frombuffer(b"".join(row_of(record) for record in records), ROW_DTYPE)


def plain_rows(
    count: int,
    reference: Iterable[float] | float = 0.0,
    velocity: Iterable[float] | float = 0.0,
    load: Iterable[float] | float = 0.0,
    fate: Iterable[int] | int = 0,
    statusword: Iterable[int] | int = 0x1637,
) -> Rows:
    """``count`` rows at 1 kHz from instant 0; scalars hold for every row."""
    rows = np.zeros(count, ROW_DTYPE)
    rows["certain"] = 1
    rows["sequence"] = np.arange(1, count + 1)
    for name in ("due_at", "woke_at", "sampled_at", "sync_on_bus_at"):
        rows[name] = np.arange(count) * 1_000_000
    columns = {
        "reference_rad_s": reference,
        "velocity_rad_s": velocity,
        "load_torque_nm": load,
        "fate": fate,
        "statusword": statusword,
    }
    for name, values in columns.items():
        rows[name] = values if isinstance(values, int | float) else list(values)
    return rows


def record_of(row: np.void) -> CycleRecord:
    """The record that was packed into ``row``; inverse of :func:`row_of`."""
    field = {name: row[name].item() for name in NAMES}
    return cycle_record(
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
        compute_ns=_duration(field["compute_ns"]),
        channels=_channels_of(field),
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


def _channels_of(field: dict[str, Any]) -> tuple[float, ...]:
    values = [field[f"channel_{number}"] for number in range(CHANNELS_MAX)]
    while values and math.isnan(values[-1]):
        values.pop()
    return tuple(values)


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
