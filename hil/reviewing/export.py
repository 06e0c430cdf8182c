"""A recording into one file of another program's format, batch by batch.

CSV and Parquet are written by pyarrow; MATLAB's MAT file, version 5, by scipy, a vector a column, one after
the other; ASAM MDF 4 by asammdf, a channel group an axis, its time the tick of the cycle in s.
"""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.written_file import written
from servobench.hil.loop.cycle_record import NOTHING, Column
from servobench.hil.reviewing.export_format import ExportFormat
from servobench.hil.reviewing.frames_export import OF_FRAMES, export_frames
from servobench.hil.rows.arrow_file import schema_of
from servobench.hil.rows.differences import fields_for, whole_batch, whole_schema
from servobench.hil.rows.faults_file import read_entries
from servobench.hil.rows.records_file import (
    check_records,
    column_of,
    damage_told,
    refuse_later_format,
    refuse_without_end,
)
from servobench.hil.rows.run_files import FAULTS_FILE, FAULTS_LOG, FRAMES_FILE, RECORDS_FILE, not_a_recording
from servobench.hil.rows.seal import NOT_CHECKED, SEALED, check_seal, seal_of
from servobench.virtual_bus.faults.fault_log import entries_of, entry_line

CHUNK_ROWS: Final = 1 << 17
"""Rows that are held at once: some 40 MB with all columns, and enough for a row group of Parquet."""
_EXACT_MAX: Final = 1 << 53
"""float64 holds every integer up to here."""
_TIME, _AXIS = "due_at", "axis"


class RecordedRows:
    """The rows of a finished run, with what their columns mean. What an earlier format had no column for is
    not there."""

    def __init__(self, folder: Path, *, unsealed: bool = False) -> None:
        """Raises BadInput for a folder without records, records without an end, a later format, and
        files that are not as they were recorded, unless ``unsealed``."""
        self.path = folder / RECORDS_FILE
        if not self.path.is_file():
            raise not_a_recording(folder, RECORDS_FILE)
        refuse_without_end(self.path)
        self.seal = NOT_CHECKED if unsealed else check_seal(folder)
        with damage_told(self.path):
            self._stored = self._open(None).schema
            self.schema = whole_schema(self._stored)
            told = self.schema.metadata or {}
            self.metadata: Mapping[str, str] = {key.decode(): value.decode() for key, value in told.items()}
            refuse_later_format(self.metadata, self.path)
            check_records(self.path)
            self.columns = tuple(map(column_of, self.schema))
            self.axes: tuple[str, ...] = tuple(json.loads(self.metadata.get("axes", "[]")))
            """Names by number."""

    def chunks(self, names: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """The rows in order, CHUNK_ROWS and a batch at a time at most; ``names``: of these columns alone."""
        reader, chosen = self._open(names), list(names or self.schema.names)
        held: list[pa.RecordBatch] = []
        for number in range(reader.num_record_batches):
            held.append(whole_batch(reader.get_batch(number)).select(chosen))
            if sum(batch.num_rows for batch in held) >= CHUNK_ROWS:
                yield pa.Table.from_batches(held).combine_chunks()
                held = []
        schema = pa.schema([self.schema.field(name) for name in chosen], self.schema.metadata)
        yield pa.Table.from_batches(held, schema).combine_chunks()

    def _open(self, names: Sequence[str] | None) -> pa.ipc.RecordBatchFileReader:
        try:
            if names is None:
                return pa.ipc.open_file(pa.OSFile(str(self.path), "rb"))
            options = pa.ipc.IpcReadOptions(included_fields=fields_for(self._stored, names))
            return pa.ipc.open_file(pa.OSFile(str(self.path), "rb"), options=options)
        except (pa.ArrowInvalid, OSError) as error:
            raise BadInput(str(self.path), "", str(error), "an Arrow IPC file") from None


class Exported(NamedTuple):
    """Description of the written file."""

    file: str
    rows: int
    columns: int
    bytes: int
    seal: str


def export_run(
    run: Path, wanted: ExportFormat, out: Path | None = None, *, unsealed: bool = False
) -> Exported:
    """Write the rows of ``run`` to ``out``, by default records.ENDING in its folder, or its frames, by
    default frames.ENDING, or its injected faults, by default faults.jsonl; ``unsealed``: whether or not its
    files are as they were recorded.

    The file is there as a whole or not at all; what is no regular file gets its content. Raises BadInput or
    DiskFull.
    """
    if wanted in OF_FRAMES:
        return _export(run, FRAMES_FILE, partial(export_frames, run, wanted), wanted, out, unsealed)
    if wanted is ExportFormat.JSONL:
        return _export(run, FAULTS_FILE, partial(_write_faults, run), wanted, out, unsealed)
    rows = RecordedRows(run, unsealed=unsealed)
    path = out or run / f"records.{wanted.value}"
    with written("--out", path, f".{wanted.value}") as part, damage_told(rows.path):
        _WRITERS[wanted](rows, part)
        size = part.stat().st_size
    with damage_told(rows.path):
        count = sum(chunk.num_rows for chunk in rows.chunks([_AXIS]))
    return Exported(str(path), count, len(rows.columns), size, rows.seal)


def _export(
    run: Path, name: str, write: Callable[[Path], int], wanted: ExportFormat, out: Path | None, unsealed: bool
) -> Exported:
    """Write the content of another file than the records."""
    if not run.is_dir():
        raise not_a_recording(run, name)
    seal = seal_of(run, unsealed=unsealed)
    source, ending = run / name, f".{wanted.value}"
    path = out or source.with_suffix(ending)
    if source.is_file():
        refuse_without_end(source)
    with written("--out", path, ending) as part:
        count = write(part)
        size = part.stat().st_size
    return Exported(str(path), count, len(schema_of(source) or ()), size, seal or SEALED)


def _write_faults(run: Path, path: Path) -> int:
    source, count = run / FAULTS_FILE, 0
    if not source.is_file():
        older = f"; {run / FAULTS_LOG} has them, a line each" if (run / FAULTS_LOG).is_file() else ""
        raise BadInput(
            str(run), "", "no injected faults", f"a recording with {FAULTS_FILE} (of a fault plan){older}"
        )
    with path.open("w", encoding="utf-8") as file:
        for entries in read_entries(source):
            file.writelines(f"{entry_line(entry)}\n" for entry in entries_of(entries.tobytes()))
            count += entries.size
    return count


# ---- CSV and Parquet ----------------------------------------------------------------------------------


def _write_csv(rows: RecordedRows, path: Path) -> None:
    """A head of names with units, words for codes and axes, nothing for null."""
    sink = None
    try:
        for chunk in rows.chunks():
            table = _in_words(rows, chunk)
            sink = sink or pyarrow.csv.CSVWriter(str(path), table.schema)
            sink.write_table(table)
    finally:
        if sink is not None:
            sink.close()


def _in_words(rows: RecordedRows, chunk: pa.Table) -> pa.Table:
    columns, names = [], []
    for column, values in zip(rows.columns, chunk.columns, strict=True):
        words = rows.axes if column.name == _AXIS else column.codes
        if pa.types.is_dictionary(values.type):
            values = values.cast(pa.string())
        elif words:
            values = pc.take(pa.array(words), values)
        columns.append(values)
        # with its unit, for which a head has no other place: due_at_ns
        instant = column.unit.startswith("ns") and not column.name.endswith("_ns")
        names.append(f"{column.name}_ns" if instant else column.name)
    return pa.table(columns, names=names)


def _write_parquet(rows: RecordedRows, path: Path) -> None:
    """Columns, units, codes, meanings and metadata as records.arrow has them."""
    # Values that hardly repeat: to look for repetitions takes most of the time, and saves nothing.
    repeating = [field.name for field in rows.schema if field.type not in (pa.int64(), pa.float64())]
    with pyarrow.parquet.ParquetWriter(
        str(path), rows.schema, compression="zstd", use_dictionary=repeating
    ) as sink:
        for chunk in rows.chunks():
            sink.write_table(chunk)


# ---- MAT ----------------------------------------------------------------------------------------------


def _write_mat(rows: RecordedRows, path: Path) -> None:
    """(n, 1) vectors by column name; also ``units``, ``meanings``, ``codes`` (cells, from 0 on), ``run``.

    An integer column with nulls is float64 with NaN, where that holds its values to the last digit; else
    int64 with its least value for null: it has no NaN.
    """
    with path.open("wb") as file:
        for column in rows.columns:
            _save(file, {column.name: _vector(rows, column.name)[:, None]})
        codes = {column.name: list(column.codes) for column in rows.columns if column.codes}
        codes[_AXIS] = list(rows.axes)
        cells = {name: np.array(words, dtype=object) for name, words in codes.items()}
        _save(file, {"units": {column.name: column.unit for column in rows.columns}})
        _save(file, {"meanings": {column.name: column.meaning for column in rows.columns}})
        _save(file, {"codes": cells})
        _save(file, {"run": dict(rows.metadata)})


def _save(file: Any, content: dict[str, Any]) -> None:
    from scipy.io import savemat

    savemat(file, content, long_field_names=True, oned_as="column")


def _vector(rows: RecordedRows, name: str) -> NDArray[Any]:
    """(n,) of all rows."""
    values = _numbers(pa.concat_tables(rows.chunks([name])).column(0), pa.int8())
    if not values.null_count:
        return np.asarray(values.to_numpy())
    known = values.drop_null().to_numpy()
    if pa.types.is_int64(values.type) and np.abs(known).max(initial=0) > _EXACT_MAX:
        return np.asarray(values.fill_null(NOTHING).to_numpy())
    return np.asarray(values.cast(pa.float64()).fill_null(np.nan).to_numpy())


def _numbers(values: pa.ChunkedArray, truth: pa.DataType) -> pa.ChunkedArray:
    """Words as their codes, true and false as 1 and 0 of the type ``truth``."""
    if pa.types.is_dictionary(values.type):
        return pa.chunked_array([part.indices for part in values.chunks], pa.int8())
    return values.cast(truth) if pa.types.is_boolean(values.type) else values


# ---- MDF ----------------------------------------------------------------------------------------------


def _write_mf4(rows: RecordedRows, path: Path) -> None:
    """Null is a sample that is marked invalid."""
    asammdf: Any = import_module("asammdf")
    columns = [column for column in rows.columns if column.name not in (_TIME, _AXIS)]
    # asammdf prints how fast it packs; stdout belongs to the command.
    with redirect_stdout(sys.stderr), asammdf.MDF(version="4.10") as sink:
        groups: dict[int, int] = {}
        for chunk in rows.chunks():
            for axis in pc.unique(chunk[_AXIS]).to_pylist():
                mine = chunk.filter(pc.equal(chunk[_AXIS], axis))
                if axis in groups:
                    sink.extend(groups[axis], _pieces(mine, columns))
                else:
                    groups[axis] = _begin(asammdf, sink, rows.axes[axis], mine, columns)
        sink.header.comment = "\n".join(f"{key}: {value}" for key, value in rows.metadata.items())
        sink.save(path, overwrite=True, compression=2)


def _begin(asammdf: Any, sink: Any, axis: str, mine: pa.Table, columns: list[Column]) -> int:
    """A group with its first rows; its number."""
    (times, _), *pieces = _pieces(mine, columns)
    signals = []
    for column, (samples, invalid) in zip(columns, pieces, strict=True):
        told = f"{column.meaning} ({', '.join(column.codes)})" if column.codes else column.meaning
        signals.append(
            asammdf.Signal(
                samples,
                times,
                unit=column.unit,
                name=f"{axis}.{column.name}",
                comment=told,
                invalidation_bits=invalid,
                conversion=_words(column),
            )
        )
    number: int = sink.append(signals, acq_name=axis, comment=axis, common_timebase=True)
    return number


def _words(column: Column) -> dict[str, Any] | None:
    """Value to text, for viewers of MF4: what a code stands for; None: its numbers are no codes."""
    if not column.codes:
        return None
    words = {f"text_{code}": text.encode() for code, text in enumerate(column.codes)}
    return {**{f"val_{code}": code for code in range(len(column.codes))}, **words, "default": b""}


def _pieces(mine: pa.Table, columns: list[Column]) -> list[tuple[NDArray[Any], NDArray[np.bool_] | None]]:
    """Return the pieces that extend a group: its time first; numbers, 0 for null, and where they are null."""
    pieces: list[tuple[NDArray[Any], NDArray[np.bool_] | None]] = [(mine[_TIME].to_numpy() / NS_PER_S, None)]
    for column in columns:
        values = _numbers(mine[column.name], pa.uint8())
        invalid = np.asarray(values.is_null().to_numpy(), bool)
        pieces.append((np.ascontiguousarray(values.fill_null(0).to_numpy()), invalid))
    return pieces


_WRITERS: Final[dict[ExportFormat, Callable[[RecordedRows, Path], None]]] = {
    ExportFormat.CSV: _write_csv,
    ExportFormat.PARQUET: _write_parquet,
    ExportFormat.MF4: _write_mf4,
    ExportFormat.MAT: _write_mat,
}
