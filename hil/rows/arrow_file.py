"""Files of the Arrow IPC format (Feather version 2) that grow batch by batch.

The batches are written as they come and the footer at the end; a truncated file is read up to its last whole
batch. Each batch can also be read by its place in the file.
"""

import os
import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.drivers.errors import BadInput

MAGIC: Final = b"ARROW1\0\0"
_MAGIC_END: Final = b"ARROW1"
_OPTIONS: Final = pa.ipc.IpcWriteOptions(compression="zstd")
DAMAGED: Final = "it is damaged; hil runs shows what it came to"
BATCH_MAX: Final = 1 << 20
"""Rows of the largest batch that is believed."""


class BatchWriter:
    """Appends batches to a new file. Every method may raise OSError, and leaves whole batches then."""

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self.schema = schema
        self._path = path
        self._file = pa.OSFile(str(path), "wb")
        self._writer = pa.ipc.new_file(self._file, schema, options=_OPTIONS)
        self.append(pa.RecordBatch.from_pylist([], schema))  # nothing is on disk before the first batch

    def append(self, batch: pa.RecordBatch) -> int:
        """Append one; return the byte at which it begins."""
        begin: int = self._file.tell()
        try:
            self._writer.write_batch(batch)
        except OSError:
            with suppress(OSError):
                os.truncate(self._path, begin)
            raise
        return begin

    def copy(self, path: Path) -> int:
        """Append the whole batches of a file to the byte; return how many rows they have."""
        count = 0
        for _, _, batch in whole_batches(path):
            if batch.num_rows:  # the head has the empty one
                self.append(batch)
                count += batch.num_rows
        return count

    def close(self) -> None:
        """Write the footer."""
        self._writer.close()
        self._file.close()

    def drop(self) -> None:
        """Close the file as it is."""
        self._file.close()


def schema_of(path: Path) -> pa.Schema | None:
    """Return the schema; None if the file was truncated before its head."""
    with pa.OSFile(str(path), "rb") as source:
        try:
            source.seek(len(MAGIC))
            return pa.ipc.read_schema(source)
        except (pa.ArrowException, OSError, EOFError):
            return None


def whole_batches(path: Path, begin: int = 0) -> Iterator[tuple[int, int, pa.RecordBatch]]:
    """Yield each whole batch behind its first byte and the one behind its last."""
    schema = None
    with pa.OSFile(str(path), "rb") as source:
        try:
            source.seek(len(MAGIC))
            schema = pa.ipc.read_schema(source)
            if begin:
                source.seek(begin)
            while True:
                place = source.tell()
                message = pa.ipc.read_message(source)
                if message.type != "record batch":
                    return
                length = length_of_batch(message)
                if not 0 <= length <= BATCH_MAX:
                    raise BadInput(
                        str(path), f"byte {place}", f"{length} rows", f"at most {BATCH_MAX}", DAMAGED
                    )
                batch = pa.ipc.read_record_batch(message, schema)
                batch.validate(full=True)
                yield place, source.tell(), batch
        except (pa.ArrowException, OSError, EOFError):
            return


def values_of(column: pa.Array) -> NDArray[Any]:
    """Return (n,) of numbers or truth values as they lie in memory.

    ``to_numpy`` would load pandas for it, which takes longer than a window of an hour is read in. Raises
    ValueError or TypeError for a column with nulls, or of another type.
    """
    if not pa.types.is_boolean(column.type):
        values: NDArray[Any] = np.from_dlpack(column)
        return values
    if column.null_count:
        raise ValueError(f"{column.null_count} nulls")
    bits = np.frombuffer(column.buffers()[1] or b"", np.uint8)
    whole = np.unpackbits(bits, count=column.offset + len(column), bitorder="little")
    return whole[column.offset :].view(np.bool_)


def finish(path: Path, schema: pa.Schema) -> None:
    """Give a truncated file of a :class:`BatchWriter` its footer; needs room for that only. Error: OSError.

    ``schema``: of one that was truncated before its head.
    """
    finish_file(
        path, schema_of(path) or schema, lambda: (batch for _, _, batch in whole_batches(path)), _OPTIONS
    )


def extend(path: Path, schema: pa.Schema, batches: Iterable[pa.RecordBatch]) -> None:
    """Put batches behind those of a file that no one writes any more, and end it.

    Error: OSError; it has its own batches then, and its end, if there is room for that.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        _write_anew(part, path, schema, batches)
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        if path.exists():
            with suppress(OSError):
                finish(path, schema)
        raise


def _write_anew(part: Path, path: Path, schema: pa.Schema, batches: Iterable[pa.RecordBatch]) -> None:
    writer = BatchWriter(part, schema)
    try:
        if path.exists():
            writer.copy(path)  # as its seal has it
        for batch in batches:
            writer.append(batch)
        writer.close()
    except OSError:
        writer.drop()  # a file that is open keeps its room on the disk
        raise


def finish_file(
    path: Path,
    schema: pa.Schema,
    batches: Callable[[], Iterable[pa.RecordBatch]],
    options: pa.ipc.IpcWriteOptions,
) -> None:
    """Give a truncated file its footer; a whole one is left alone. ``batches``: its whole ones; ``options``:
    those with which they were written.

    Error: OSError.
    """
    if is_whole(path):
        return
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, schema, options=options) as writer:
        for batch in batches():
            writer.write_batch(batch)
        end = sink.tell()
    whole = sink.getvalue().to_pybytes()
    with path.open("r+b") as file:
        kept = end if file.read(end) == whole[:end] else 0
        file.seek(kept)
        file.write(whole[kept:])
        file.truncate()


def is_whole(path: Path) -> bool:
    """Return True if the file has its end."""
    with path.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - len(_MAGIC_END)))
        return file.read(len(_MAGIC_END)) == _MAGIC_END


def length_of_batch(message: pa.ipc.Message) -> int:
    """Rows of a record batch, as its head tells them; -1 if that is damaged."""
    return _length_of(message.metadata.to_pybytes())


def _length_of(head: bytes) -> int:
    """Of the Message of a RecordBatch (Arrow's Message.fbs): the first field of the table in its third."""

    def field(table: int, number: int) -> int:
        """Where it lies, 0 if it is left out, by the FlatBuffers encoding: a table begins with the distance
        to its vtable, which has its own length, the table's, and the places of the fields."""
        (back,) = struct.unpack_from("<i", head, table)
        length, *_ = struct.unpack_from("<HH", head, table - back)
        at = 4 + 2 * number
        place = struct.unpack_from("<H", head, table - back + at)[0] if at < length else 0
        return table + int(place) if place else 0

    def followed(place: int) -> int:
        return place + int(struct.unpack_from("<I", head, place)[0])

    try:
        rows = field(followed(field(followed(0), 2)), 0)
        return int(struct.unpack_from("<q", head, rows)[0]) if rows else 0
    except struct.error:
        return -1
