"""Columns of cycle records that are held as differences from others, and called so: ``woke_at-due_at``.

zstd keeps three to eight bytes of an instant or a real number, and next to none of the difference of two that
belong together: an hour of an axis takes 0.14 GB for 0.31. A file up to format 6 has each column itself; both
are read.
"""

import re
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.hil.loop.cycle_record import COLUMNS
from servobench.hil.rows.arrow_file import values_of

DIFFERENCES: Final[Mapping[str, str]] = {
    "woke_at": "woke_at-due_at",
    "sync_handed_at": "sync_handed_at-woke_at",
    "sync_on_bus_at": "sync_on_bus_at-sync_handed_at",
    "sampled_at": "sampled_at-sync_on_bus_at",
    "device_time_ns": "device_time_ns-sampled_at",
    "received_at": "received_at-sampled_at-delay_ns",
    "position_told_at": "position_told_at-due_at",
    "torque_told_at": "torque_told_at-position_told_at",
    "estimate_position_rad": "estimate_position_rad^position_rad",
    "estimate_velocity_rad_s": "estimate_velocity_rad_s^velocity_rad_s",
    "estimate_torque_nm": "estimate_torque_nm^torque_nm",
    "estimate_valid_at": "estimate_valid_at-sampled_at",
    "estimate_sequence": "estimate_sequence-sequence",
    "command_handed_at": "command_handed_at-received_at",
    "command_effective_at": "command_effective_at-command_handed_at",
    "command_expires_at": "command_expires_at-command_effective_at",
    "command_on_bus_at": "command_on_bus_at-command_handed_at",
    "command_acts_after": "command_acts_after-command_on_bus_at",
    "command_acts_by": "command_acts_by-sync_on_bus_at",
}
"""Names in the file. Behind a minus stands what is taken from whole numbers; behind ``^`` what the 64 bits of
real ones are held against, by exclusive or. Null counts as 0."""
_KNOWN: Final = {column.name: column for column in COLUMNS}


@cache
def names_in(stored: str) -> tuple[str, ...]:
    """Name of the column that one of a file holds, and of those that it was held against."""
    return tuple(re.split("[-^]", stored))


def stored_schema(schema: pa.Schema) -> pa.Schema:
    """Return the schema of the file for that of the columns themselves."""
    for name, stored in DIFFERENCES.items():
        place = schema.get_field_index(name)
        unit = "ns" if "-" in stored and _KNOWN[name].unit else ""
        schema = schema.set(place, _described(schema.field(place), stored, pa.int64(), unit))
    return schema


def whole_schema(schema: pa.Schema) -> pa.Schema:
    """Return the schema of the columns themselves for that of a file."""
    for place, field in enumerate(schema):
        name, *others = names_in(field.name)
        if others and name in _KNOWN:
            column = _KNOWN[name]
            kind = pa.type_for_alias(column.kind)
            schema = schema.set(place, _described(field, name, kind, column.unit))
    return schema


def _described(field: pa.Field, name: str, kind: pa.DataType, unit: str) -> pa.Field:
    told = {key: value for key, value in (field.metadata or {}).items() if key != b"unit"}
    return pa.field(name, kind, metadata={**told, b"unit": unit.encode()} if unit else told)


def stored_batch(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return a batch of the file for one of the columns themselves."""
    columns = {name: batch.column(name) for name in batch.schema.names}
    itself = WholeColumns(batch)
    whole = {name: itself.bits(name) for stored in DIFFERENCES.values() for name in names_in(stored)}
    for name, stored in DIFFERENCES.items():
        values = whole[name]
        for other in names_in(stored)[1:]:
            values = values ^ whole[other] if "^" in stored else values - whole[other]
        columns[name] = _like(columns[name], values)
    return pa.record_batch([*columns.values()], schema=stored_schema(batch.schema))


class WholeColumns:
    """The columns themselves of a batch of a file."""

    def __init__(self, batch: pa.RecordBatch) -> None:
        self._stored = {
            names_in(stored)[0]: (stored, column)
            for stored, column in zip(batch.schema.names, batch.columns, strict=True)
        }
        self._bits: dict[str, NDArray[np.int64]] = {}
        self._nothing: dict[str, NDArray[np.bool_]] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._stored

    def stored(self, name: str) -> tuple[str, pa.Array]:
        """Return the name of a column in the file, and what the file has of it. Raises LookupError."""
        return self._stored[name]

    def bits(self, name: str) -> NDArray[np.int64]:
        """Return a column's values, whole numbers or the 64 bits of real ones, (n,), and 0 for null.

        Raises LookupError for one that lacks another.
        """
        if name not in self._bits:
            held, column = self._stored[name]
            bits = _bits(column)
            for other in names_in(held)[1:]:
                bits = bits ^ self.bits(other) if "^" in held else bits + self.bits(other)
            nothing = self.nothing(name)
            self._bits[name] = bits if nothing is None else np.where(nothing, 0, bits)
        return self._bits[name]

    def nothing(self, name: str) -> NDArray[np.bool_] | None:
        """Return where a column is null, (n,); None if nowhere."""
        if name not in self._nothing:
            _, column = self._stored[name]
            if not column.null_count:
                return None
            self._nothing[name] = values_of(column.is_null())
        return self._nothing[name]


def whole_batch(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return the columns themselves for a batch of a file. Raises LookupError for one that lacks another."""
    columns = WholeColumns(batch)

    def whole(stored: str) -> pa.Array:
        name, *others = names_in(stored)
        column = columns.stored(name)[1]
        if not others:
            return column
        bits = columns.bits(name)
        return _like(column, bits.view(np.float64) if "^" in stored else bits)

    return pa.record_batch([whole(name) for name in batch.schema.names], schema=whole_schema(batch.schema))


def fields_for(schema: pa.Schema, names: Iterable[str]) -> list[int]:
    """Return the places in a file of columns, and of those that they were held against."""
    stored = {names_in(field.name)[0]: place for place, field in enumerate(schema)}
    wanted = [name for name in names if name in stored]
    for name in wanted:  # which grows
        others = names_in(schema.field(stored[name]).name)[1:]
        wanted += [other for other in others if other in stored and other not in wanted]
    return [stored[name] for name in wanted]


def _bits(column: pa.Array) -> NDArray[np.int64]:
    """Values as whole numbers, real ones by their 64 bits, (n,); any for null."""
    if not pa.types.is_floating(column.type) and column.type != pa.int64():
        column = column.cast("int64")
    if column.null_count:
        values = column.buffers()[1]
        column = pa.Array.from_buffers(column.type, len(column), [None, values], 0, column.offset)
    return values_of(column).view(np.int64)


def _like(column: pa.Array, values: NDArray[np.int64] | NDArray[np.float64]) -> pa.Array:
    """Other values, null where the column is."""
    if not column.null_count:
        return pa.array(values)
    nothing = values_of(column.is_null())
    return pa.array(np.where(nothing, 0, values), mask=nothing)
