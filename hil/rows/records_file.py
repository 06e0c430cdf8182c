"""The cycle records on disk, by column: an Arrow IPC file (Feather version 2) with zstd.

Every program that knows Arrow opens it as it is. Its batches are written as they come, one about each second,
and what names their places, the footer, at the end: what lies before that is an IPC stream behind the file's
first eight bytes, by which a file that was cut off is read, and finished (:func:`finish_records`).

Instants are in run time, ns since the first cycle; what is not known is null.
"""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Instant
from servobench.hil.rows.records import COLUMNS, FATE_SAMPLE, NOTHING, ROW_DTYPE, Column, Rows
from servobench.hil.rows.run_files import FORMAT

MAGIC = b"ARROW1\0\0"
_MAGIC_END = b"ARROW1"
_OPTIONS = pa.ipc.IpcWriteOptions(compression="zstd")

RUN: Final = "run"
PHASES: Final = ("calibrating", RUN, "stopping")
PHASE_COLUMN: Final = Column("phase", "string", "", "in which phase of the bench the row was taken", PHASES)


def refuse_later_format(metadata: Mapping[str, str], source: Path) -> None:
    """Raises BadInput for a recording whose format counts higher than FORMAT; earlier ones are read."""
    told = metadata.get("format", FORMAT)
    if not told.isdecimal() or int(told) > int(FORMAT):
        expected = f"a recording of format {FORMAT} or earlier"
        raise BadInput(
            str(source), "format", told, expected, "read it with the servobench that wrote it, or later"
        )


@contextmanager
def damage_told(path: Path) -> Iterator[None]:
    """Raises BadInput for a file whose content is no cycle records, as Arrow and numpy find it out."""
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

    def begin(self, metadata: Mapping[str, str], zero: Instant) -> None:
        """Write the head. ``zero``: the first cycle on the bench clock. Error: OSError."""
        self._zero = zero
        self._schema = records_schema(metadata)
        self._writer = pa.ipc.new_file(self._file, self._schema, options=_OPTIONS)
        self.write(np.empty(0, ROW_DTYPE))  # nothing is on disk before the first batch

    def write(self, rows: Rows) -> None:
        """Append one batch: (n,) of ROW_DTYPE, on the bench clock. Error: OSError if the disk is full."""
        assert self._writer is not None
        self._writer.write_batch(_batch(rows, self._schema, self._zero))

    def copy(self, path: Path) -> None:
        """Append the whole batches of a file to the byte, behind a head with its metadata. Error: OSError."""
        assert self._writer is not None
        for batch in _batches(path):
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
    """Columns with their units and codes; ``metadata``: of the run."""
    fields = [
        *[_field(column, pa.type_for_alias(column.kind)) for column in COLUMNS],
        _field(PHASE_COLUMN, pa.dictionary(pa.int8(), pa.string())),
    ]
    return pa.schema(fields, metadata={"format": FORMAT, **metadata})


def _field(column: Column, kind: pa.DataType) -> pa.Field:
    """With what is said of the column."""
    told = {"meaning": column.meaning}
    if column.unit:
        told["unit"] = column.unit
    if column.codes:
        told["codes"] = json.dumps(dict(enumerate(column.codes)))
    return pa.field(column.name, kind, metadata=told)


def column_of(field: pa.Field) -> Column:
    """What the field of a file tells of its column."""
    told = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    codes: dict[str, str] = json.loads(told.get("codes", "{}"))
    in_order = tuple(codes[number] for number in sorted(codes, key=int))
    return Column(field.name, str(field.type), told.get("unit", ""), told.get("meaning", ""), in_order)


def records_table(rows: Rows, metadata: Mapping[str, str], zero: Instant) -> pa.Table:
    """The content of a file: (n,) of ROW_DTYPE on the bench clock; ``metadata``: of the run."""
    return pa.Table.from_batches([_batch(rows, records_schema(metadata), zero)])


def rows_of_table(table: pa.Table) -> Rows:
    """(n,) of ROW_DTYPE in run time."""
    return np.concatenate([np.empty(0, ROW_DTYPE), *(_rows_of(batch, 0) for batch in table.to_batches())])


def read_table(path: Path) -> pa.Table:
    """The batches of a file that are whole, with units and metadata; of a file without a head: none."""
    return pa.Table.from_batches(_batches(path), schema=_schema_of(path) or records_schema({}))


def read_metadata(path: Path) -> dict[str, str]:
    """What the file says of the run; empty if it was cut off before its head."""
    schema = _schema_of(path)
    metadata = {} if schema is None else schema.metadata or {}
    with damage_told(path):
        return {key.decode(): value.decode() for key, value in metadata.items()}


def read_records(path: Path, first_cycle: int = 0) -> Iterator[Rows]:
    """The batches of a file in order, each (n,) of ROW_DTYPE. A batch that was cut off ends it.

    ``first_cycle``: what their instants are to count it as; the metadata have it on the bench clock, too.
    """
    for batch in _batches(path):
        with damage_told(path):
            rows = _rows_of(batch, first_cycle)
        yield rows


def finish_records(path: Path) -> int:
    """Give a file that was cut off its footer, and return its number of rows; a whole one is left as it is.

    What was not written whole is left out. It needs room for the footer alone. Error: OSError.
    """
    count: int = sum(batch.num_rows for batch in _batches(path))
    if is_whole(path):
        return count
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, _schema_of(path) or records_schema({}), options=_OPTIONS) as writer:
        for batch in _batches(path):
            writer.write_batch(batch)
        end = sink.tell()
    whole = sink.getvalue().to_pybytes()
    with path.open("r+b") as file:
        kept = end if file.read(end) == whole[:end] else 0
        file.seek(kept)
        file.write(whole[kept:])
        file.truncate()
    return count


def _schema_of(path: Path) -> pa.Schema | None:
    """None if the file was cut off before its head."""
    with pa.OSFile(str(path), "rb") as source:
        try:
            return _stream(source).schema
        except (pa.ArrowException, OSError):
            return None


def is_whole(path: Path) -> bool:
    """Whether the file has its end."""
    with path.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - len(_MAGIC_END)))
        return file.read() == _MAGIC_END


def _stream(source: pa.NativeFile) -> pa.RecordBatchStreamReader:
    """What lies between the file's first bytes and its footer."""
    source.seek(len(MAGIC))
    return pa.ipc.open_stream(source)


def _batches(path: Path) -> Iterator[pa.RecordBatch]:
    """Those that are whole."""
    with pa.OSFile(str(path), "rb") as source:
        try:
            reader = _stream(source)
            while True:
                batch = reader.read_next_batch()
                batch.validate(full=True)
                yield batch
        except (StopIteration, pa.ArrowException, OSError):
            return


def _batch(rows: Rows, schema: pa.Schema, zero: Instant) -> pa.RecordBatch:
    columns = [_column(rows[each.name], each, zero) for each in COLUMNS]
    phases = pa.DictionaryArray.from_arrays(np.full(rows.size, PHASES.index(RUN), np.int8), list(PHASES))
    return pa.record_batch([*columns, phases], schema=schema)


def _column(values: NDArray[Any], column: Column, zero: Instant) -> pa.Array:
    """Of one batch, with nulls and in run time."""
    if column.is_real:
        return pa.array(np.ascontiguousarray(values), mask=np.isnan(values))
    nothing = (values == NOTHING) | (values == column.none)
    moved = values - zero if column.is_instant else values
    return pa.array(np.where(nothing, 0, moved), mask=nothing).cast(column.kind)


def _rows_of(batch: pa.RecordBatch, first_cycle: int) -> Rows:
    rows = np.empty(batch.num_rows, ROW_DTYPE)
    for column in COLUMNS:
        if column.name not in batch.schema.names:  # of a later format than the file
            rows[column.name] = np.nan if column.is_real else NOTHING
            continue
        stored = batch.column(column.name)
        if not column.is_real:
            stored = stored.cast("int64").fill_null(NOTHING)
        values = stored.to_numpy(zero_copy_only=False)
        if column.is_instant and first_cycle:
            values = np.where(values == NOTHING, NOTHING, values + first_cycle)
        if column.none != NOTHING:  # what a reading lacks is written otherwise than a reading that lacks
            values = np.where((values == NOTHING) & (rows["fate"] == FATE_SAMPLE), column.none, values)
        rows[column.name] = values
    return rows
