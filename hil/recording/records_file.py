"""The cycle records on disk, by column: an Arrow IPC stream with zstd, one batch about each second.

A stream has no footer, so a file that was cut off is readable up to its last whole batch, and
pandas, polars and DuckDB read it as it is.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from hil.recording.records import ROW_DTYPE, Rows

RECORDS_FILE = "records.arrow"
_END_OF_STREAM = b"\xff\xff\xff\xff\0\0\0\0"
"""Arrow columnar format 1.3, IPC streaming format: continuation and a length of 0."""


class RecordsWriter:
    """Appends batches of rows to a new file."""

    def __init__(self, path: Path) -> None:
        self._file = pa.OSFile(str(path), "wb")
        self._schema = pa.schema([(name, pa.from_numpy_dtype(ROW_DTYPE[name])) for name in _names()])
        options = pa.ipc.IpcWriteOptions(compression="zstd")
        self._stream = pa.ipc.new_stream(self._file, self._schema, options=options)

    def write(self, rows: Rows) -> None:
        """Append one batch: (n,) of ROW_DTYPE. Error: OSError if the disk is full."""
        columns = [pa.array(np.ascontiguousarray(rows[name])) for name in _names()]
        self._stream.write_batch(pa.record_batch(columns, schema=self._schema))

    def close(self) -> None:
        """End the stream."""
        self._stream.close()
        self._file.close()


def read_records(path: Path) -> Iterator[Rows]:
    """The batches of a file in order, each (n,) of ROW_DTYPE. A batch that was cut off ends it."""
    with pa.OSFile(str(path), "rb") as source:
        try:
            reader = pa.ipc.open_stream(source)
            while True:
                yield _rows_of(reader.read_next_batch())
        except (StopIteration, pa.ArrowInvalid, OSError):
            return


def finish_records(path: Path) -> None:
    """End a file that was cut off behind its last whole batch. Error: OSError."""
    whole = 0
    with pa.OSFile(str(path), "rb") as source:
        try:
            reader = pa.ipc.open_stream(source)
            while True:
                whole = source.tell()
                reader.read_next_batch()
        except (StopIteration, pa.ArrowInvalid, OSError):
            pass
    if whole == 0:
        RecordsWriter(path).close()
        return
    with open(path, "r+b") as file:
        file.truncate(whole)
        file.seek(whole)
        file.write(_END_OF_STREAM)


def _rows_of(batch: pa.RecordBatch) -> Rows:
    rows = np.empty(batch.num_rows, ROW_DTYPE)
    for name in _names():
        rows[name] = batch.column(name).to_numpy()
    return rows


def _names() -> tuple[str, ...]:
    assert ROW_DTYPE.names is not None
    return ROW_DTYPE.names
