"""The cycle records on disk, by column: an Arrow IPC file (Feather version 2) with zstd.

Every program that knows Arrow opens it as it is. Its batches are written as they come, about one a second,
and the footer with their places at the end: before it the file is an IPC stream after the first eight bytes,
by which a truncated file is read, and finished (:func:`finish_records`).

Instants are in run time, ns since the first cycle; unknown values are null.

Columns that follow others closely are held as differences (:mod:`servobench.hil.rows.differences`); readers
here give the columns themselves.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Instant
from servobench.hil.loop.cycle_record import COLUMNS, FATE_SAMPLE, NAMES, NOTHING, Column
from servobench.hil.rows.arrow_file import MAGIC, finish_file, is_whole, length_of_batch
from servobench.hil.rows.differences import (
    WholeColumns,
    fields_for,
    stored_batch,
    stored_schema,
    whole_batch,
    whole_schema,
)
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.run_files import FORMAT

_OPTIONS = pa.ipc.IpcWriteOptions(compression=pa.Codec("zstd", 2))
"""Takes the time of level 1, and 5 to 9 % less room; level 5 takes twice the time for another 2 %."""

BATCH_ROWS_MAX: Final = 1 << 20
"""One is written each second, or when 8192 rows have come: so many take half a gigabyte of memory."""
_DAMAGED: Final = "it is damaged; hil trace shows its frames, hil runs what it came to"
_ALWAYS: Final = frozenset(NAMES[: NAMES.index("compute_ns")])
"""Columns of every format."""
_NEVER_NULL: Final = ("sequence", "axis", "due_at", "fate", "certain")
_ALIASES: Final = {"float64": "double"}
"""Names of types as Arrow writes them."""
RUN: Final = "run"
PHASES: Final = ("calibrating", RUN, "stopping")
PHASE_COLUMN: Final = Column("phase", "string", "", "in which phase of the bench the row was taken", PHASES)


def refuse_later_format(metadata: Mapping[str, str], source: Path) -> None:
    """Raise BadInput for a recording of a later format than FORMAT; earlier ones are read."""
    told = metadata.get("format", FORMAT)
    if not told.isdecimal() or int(told) > int(FORMAT):
        expected = f"a recording of format {FORMAT} or earlier"
        raise BadInput(
            str(source), "format", told, expected, "read it with the servobench that wrote it, or later"
        )


@contextmanager
def damage_told(path: Path) -> Iterator[None]:
    """Raise BadInput for a file that holds no cycle records, as Arrow and numpy detect it."""
    try:
        yield
    except (pa.ArrowException, ValueError, TypeError, LookupError, ArithmeticError, MemoryError) as error:
        said = (str(error).splitlines() or [type(error).__name__])[0]
        raise BadInput(str(path), "", said, "cycle records as they were written: it is damaged") from None


class RecordsWriter:
    """Appends batches of rows to a new file."""

    def __init__(self, path: Path) -> None:
        self._file = pa.OSFile(str(path), "wb")
        self._schema: pa.Schema | None = None
        self._writer: pa.RecordBatchFileWriter | None = None
        self._zero = Instant(0)
        self._whole = False

    def begin(self, metadata: Mapping[str, str], zero: Instant, like: Path | None = None) -> None:
        """Write the head. ``zero``: the first cycle on the bench clock; ``like``: a file that will be copied,
        which up to format 6 has the columns themselves. Error: OSError."""
        self._zero = zero
        self._schema = records_schema(metadata)
        earlier = None if like is None else _schema_of(like)
        self._whole = earlier is not None and earlier.names == self._schema.names
        schema = self._schema if self._whole else stored_schema(self._schema)
        self._writer = pa.ipc.new_file(self._file, schema, options=_OPTIONS)
        self.write(np.empty(0, ROW_DTYPE))  # nothing is on disk before the first batch

    def write(self, rows: Rows) -> None:
        """Append one batch: (n,) of ROW_DTYPE, on the bench clock. Error: OSError if the disk is full."""
        assert self._writer is not None
        batch = _batch(rows, self._schema, self._zero)
        self._writer.write_batch(batch if self._whole else stored_batch(batch))

    def copy(self, path: Path) -> None:
        """Append the whole batches of a file to the byte, after a head with its metadata. Error: OSError."""
        assert self._writer is not None
        for batch in _stored_batches(path):
            if batch.num_rows:  # the head has the empty one
                self._writer.write_batch(batch)

    def close(self) -> None:
        """Write the footer."""
        if self._writer is not None:
            self._writer.close()
        self._file.close()

    def drop(self) -> None:
        """Close the file as it is."""
        self._file.close()


def records_schema(metadata: Mapping[str, str]) -> pa.Schema:
    """Return the columns with their units and codes; ``metadata``: of the run."""
    fields = [
        *[_field(column, pa.type_for_alias(column.kind)) for column in COLUMNS],
        _field(PHASE_COLUMN, pa.dictionary(pa.int8(), pa.string())),
    ]
    return pa.schema(fields, metadata={"format": FORMAT, **metadata})


def _field(column: Column, kind: pa.DataType) -> pa.Field:
    """Return a field with the column's description."""
    told = {"meaning": column.meaning}
    if column.unit:
        told["unit"] = column.unit
    if column.codes:
        told["codes"] = json.dumps(dict(enumerate(column.codes)))
    return pa.field(column.name, kind, metadata=told)


def column_of(field: pa.Field) -> Column:
    """Return the column described by a file's field."""
    told = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    codes: dict[str, str] = json.loads(told.get("codes", "{}"))
    in_order = tuple(codes[number] for number in sorted(codes, key=int))
    return Column(field.name, str(field.type), told.get("unit", ""), told.get("meaning", ""), in_order)


def records_table(rows: Rows, metadata: Mapping[str, str], zero: Instant) -> pa.Table:
    """Return the content of a file: (n,) of ROW_DTYPE on the bench clock; ``metadata``: of the run."""
    return pa.Table.from_batches([_batch(rows, records_schema(metadata), zero)])


def rows_of_table(table: pa.Table) -> Rows:
    """Return (n,) of ROW_DTYPE in run time."""
    return np.concatenate([np.empty(0, ROW_DTYPE), *(_rows_of(batch, 0) for batch in table.to_batches())])


def read_table(path: Path) -> pa.Table:
    """Read the whole batches of a file, with units and metadata; none from a file without a head."""
    schema = _schema_of(path)
    whole = records_schema({}) if schema is None else whole_schema(schema)
    return pa.Table.from_batches(_batches(path), schema=whole)


def read_metadata(path: Path) -> dict[str, str]:
    """Read the file's data about the run; empty if it was truncated before its head."""
    schema = _schema_of(path)
    metadata = {} if schema is None else schema.metadata or {}
    with damage_told(path):
        return {key.decode(): value.decode() for key, value in metadata.items()}


def read_records(path: Path, first_cycle: int = 0, columns: Sequence[str] = NAMES) -> Iterator[Rows]:
    """Yield the batches of a file in order, each (n,) of ROW_DTYPE. A truncated batch ends it.

    ``first_cycle``: its instant on their scale; the metadata have it on the bench clock, too. ``columns``:
    those that the rows have, in this order; ``fate`` among them.
    """
    schema = None if columns is NAMES else _schema_of(path)
    options = None
    if schema is not None:
        _check_schema(path, schema)
        options = pa.ipc.IpcReadOptions(included_fields=fields_for(schema, columns))
    for batch in _stored_batches(path, options):
        with damage_told(path):
            rows = _rows_of(batch, first_cycle, columns)
        yield rows


def read_some(path: Path, numbers: Iterable[int]) -> Iterator[Rows]:
    """As :func:`read_records`, the batches of these numbers alone, from 0 on, of a file that is whole.

    Raises BadInput for one that holds what no recording has.
    """
    with damage_told(path), pa.OSFile(str(path), "rb") as source:
        reader = pa.ipc.open_file(source)
        for number in numbers:
            batch = reader.get_batch(number)
            batch.validate(full=True)
            _check_values(path, f"batch {number + 1}", batch)
            yield _rows_of(batch, 0)


def finish_records(path: Path) -> int:
    """Give a truncated file its footer, and return its number of rows; a whole one is left alone.

    Incomplete batches are dropped. It needs room for the footer only. Error: OSError.
    """
    schema = _schema_of(path) or stored_schema(records_schema({}))
    finish_file(path, schema, lambda: _stored_batches(path), _OPTIONS)
    return sum(batch.num_rows for batch in _stored_batches(path))


def _schema_of(path: Path) -> pa.Schema | None:
    """Return the schema; None if the file was truncated before its head."""
    with pa.OSFile(str(path), "rb") as source:
        try:
            return _stream(source).schema
        except (pa.ArrowException, OSError):
            return None


def refuse_without_end(path: Path) -> None:
    """Raise BadInput if records or frames of a run have not come to their end, or have lost it."""
    if not is_whole(path):
        remedy = f"once it has ended: hil recover {path.parent}"
        raise BadInput(str(path), "", "no end of the file", "the recording of a run that has ended", remedy)


def _stream(
    source: pa.NativeFile, options: pa.ipc.IpcReadOptions | None = None
) -> pa.RecordBatchStreamReader:
    """Return the stream between the file's first bytes and its footer."""
    source.seek(len(MAGIC))
    return pa.ipc.open_stream(source, options=options)


def _batches(path: Path, options: pa.ipc.IpcReadOptions | None = None) -> Iterator[pa.RecordBatch]:
    """Yield the whole batches with the columns themselves. Raises BadInput as for those of the file."""
    for batch in _stored_batches(path, options):
        with damage_told(path):
            whole = whole_batch(batch)
        yield whole


def _stored_batches(path: Path, options: pa.ipc.IpcReadOptions | None = None) -> Iterator[pa.RecordBatch]:
    """Yield the whole batches as they lie there. Raises BadInput for one that holds what no recording has."""
    number = 0
    with pa.OSFile(str(path), "rb") as source, pa.OSFile(str(path), "rb") as ahead:
        try:
            reader = _stream(source, options)
            if options is None:
                _check_schema(path, reader.schema)
            ahead.seek(len(MAGIC))
            messages = pa.ipc.MessageReader.open_stream(ahead)
            while True:
                length = _next_length(messages)
                if not 0 <= length <= BATCH_ROWS_MAX:
                    place = f"batch {number + 1}"
                    raise BadInput(str(path), place, f"{length} rows", f"at most {BATCH_ROWS_MAX}", _DAMAGED)
                batch = reader.read_next_batch()
                batch.validate(full=True)
                number += 1
                _check_values(path, f"batch {number}", batch)
                yield batch
        except (StopIteration, pa.ArrowException, OSError):
            return


def _next_length(messages: pa.ipc.MessageReader) -> int:
    """Rows of the next batch, as its head tells them before its columns are unpacked.

    Raises StopIteration behind the last.
    """
    while (message := messages.read_next_message()).type != "record batch":
        pass
    return length_of_batch(message)


def _check_schema(path: Path, schema: pa.Schema) -> None:
    """Raises BadInput for a column that is missing or of another type."""
    kinds = {field.name: str(field.type) for field in whole_schema(schema)}
    for column in COLUMNS:
        kind = kinds.get(column.name, "no such column" if column.name in _ALWAYS else column.kind)
        if kind not in (column.kind, _ALIASES.get(column.kind)):
            raise BadInput(str(path), f"column {column.name}", kind, column.kind, _DAMAGED)


def _check_values(path: Path, place: str, batch: pa.RecordBatch) -> None:
    """Raises BadInput for nulls where there can be none, and for codes that stand for nothing."""
    for name, count in _codes(batch.schema):
        if name not in batch.schema.names:  # it was not asked for
            continue
        values, where = batch.column(name), f"{place}, column {name}"
        if values.null_count and name in _NEVER_NULL:
            raise BadInput(str(path), where, f"{values.null_count} nulls", "a value in each row", _DAMAGED)
        if not count or not len(values):
            continue
        from pyarrow.compute import min_max  # as slow to import as all else of pyarrow, and only read here

        for code in min_max(values).as_py().values():
            if code is not None and not 0 <= code < count:
                raise BadInput(str(path), where, code, f"0 to {count - 1}", _DAMAGED)


def _codes(schema: pa.Schema) -> Iterator[tuple[str, int]]:
    """Columns whose values are checked, and how many codes they have; 0: they are no codes."""
    axes = (schema.metadata or {}).get(b"axes")
    for column in COLUMNS:
        if column.name == "axis" and axes is not None:
            yield column.name, len(json.loads(axes))
        elif column.codes or column.name in _NEVER_NULL:
            yield column.name, len(column.codes)


def check_records(path: Path) -> None:
    """Look at what is checked of a file's batches, for who reads them by other means. Raises BadInput."""
    schema = _schema_of(path)
    if schema is not None:
        _check_schema(path, schema)
        places = fields_for(schema, [name for name, _ in _codes(schema)])
        for _ in _stored_batches(path, pa.ipc.IpcReadOptions(included_fields=places)):
            pass


def _batch(rows: Rows, schema: pa.Schema, zero: Instant) -> pa.RecordBatch:
    columns = [_column(rows[each.name], each, zero) for each in COLUMNS]
    phases = pa.DictionaryArray.from_arrays(np.full(rows.size, PHASES.index(RUN), np.int8), list(PHASES))
    return pa.record_batch([*columns, phases], schema=schema)


def _column(values: NDArray[Any], column: Column, zero: Instant) -> pa.Array:
    """Convert a column of one batch, with nulls and in run time."""
    if column.is_real:
        return pa.array(np.ascontiguousarray(values), mask=np.isnan(values))
    nothing = (values == NOTHING) | (values == column.none)
    moved = values - zero if column.is_instant else values
    return pa.array(np.where(nothing, 0, moved), mask=nothing).cast(column.kind)


def _rows_of(batch: pa.RecordBatch, first_cycle: int, columns: Sequence[str] = NAMES) -> Rows:
    """``batch``: as it lies in a file, or with the columns themselves."""
    whole = WholeColumns(batch)
    rows = np.empty(batch.num_rows, np.dtype([(name, ROW_DTYPE[name]) for name in columns]))
    for column in (each for each in COLUMNS if each.name in columns):
        values = rows[column.name]
        if column.name not in whole:  # of a later format than the file
            values[:] = np.nan if column.is_real else NOTHING
            continue
        bits, nothing = whole.bits(column.name), whole.nothing(column.name)
        values[:] = bits.view(np.float64) if column.is_real else bits
        if column.is_instant and first_cycle:
            values += first_cycle
        if nothing is not None:
            values[nothing] = np.nan if column.is_real else NOTHING
            if column.none != NOTHING:  # what a reading lacks is written otherwise than a reading that lacks
                values[nothing & (rows["fate"] == FATE_SAMPLE)] = column.none
    return rows
