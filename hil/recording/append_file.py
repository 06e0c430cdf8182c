"""A file that grows at its end and has no half entries there, also when the disk is full.

Rows that are not yet in their file, as they came, so that they survive a logger that is killed.

Rows of cycles and injected faults wait until there are enough for a batch of columns, frames until no earlier
one can come.

    0   magic, row size       8 bytes, u64
    16  rows before these     u64, that the file holds when this one begins anew
    24  rows
"""

import os
import struct
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray


class AppendFile:
    """A file without a buffer of its own: what is written survives this process, and no close tries again."""

    def __init__(self, path: Path, *, fresh: bool = True) -> None:
        """``fresh``: empty to begin with; otherwise it goes on behind the last whole line."""
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            self._size = 0 if fresh else _whole_lines(self._descriptor)
            if os.fstat(self._descriptor).st_size:
                os.ftruncate(self._descriptor, self._size)
        except OSError:
            self.close()
            raise

    def write(self, data: bytes, *, unit: int = 0) -> None:
        """All of ``data``, or as many entries of ``unit`` bytes as fit; without it, nothing.

        Error: OSError; the file is closed then.
        """
        view = memoryview(data)
        end = self._size
        try:
            while view:
                count = os.pwrite(self._descriptor, view, end)
                view, end = view[count:], end + count
        except OSError:
            fits = (end - self._size) // unit * unit if unit else 0
            if end > self._size + fits:
                os.ftruncate(self._descriptor, self._size + fits)
            self.close()
            raise
        self._size = end

    def restart(self, data: bytes) -> None:
        """Begin anew with ``data``. Error: as of ``write``."""
        os.ftruncate(self._descriptor, 0)
        self._size = 0
        self.write(data)

    def sync(self) -> None:
        """Wait until the disk has it. Error: OSError."""
        os.fsync(self._descriptor)

    def close(self) -> None:
        os.close(self._descriptor)


def _whole_lines(descriptor: int) -> int:
    """Length without what follows the last line feed, bytes."""
    end = os.fstat(descriptor).st_size
    while end:
        start = max(0, end - 65_536)
        newline = os.pread(descriptor, end - start, start).rfind(b"\n")
        if newline >= 0:
            return start + newline + 1
        end = start
    return 0


TAIL_FILE: Final = "records.tail"
FRAMES_TAIL_FILE: Final = "frames.tail"
FAULTS_TAIL_FILE: Final = "faults.tail"
_MAGIC = b"rowtail1"
_HEADER = struct.Struct("<8sQQ")


class Tail:
    """The writer's side."""

    def __init__(self, path: Path, dtype: "np.dtype[np.void]") -> None:
        self._path = path
        self._dtype = dtype
        self._file = AppendFile(path)
        self.restart(0)

    def append(self, rows: NDArray[np.void]) -> None:
        """Keep ``rows``, (n,). Error: OSError if the disk is full; as many as fit are kept then."""
        self._file.write(rows.tobytes(), unit=self._dtype.itemsize)

    def restart(self, stored: int, rows: NDArray[np.void] | None = None) -> None:
        """The file holds the first ``stored`` rows of the run, and this one ``rows`` behind them."""
        # numpy drops the padding of rows that it joins
        kept = b"" if rows is None else rows.astype(self._dtype).tobytes()
        self._file.restart(_HEADER.pack(_MAGIC, self._dtype.itemsize, stored) + kept)

    def remove(self) -> None:
        """The file is whole."""
        self._file.close()
        self._path.unlink()


def read_tail(path: Path, dtype: "np.dtype[np.void]", stored: int) -> NDArray[np.void]:
    """The rows behind the first ``stored`` ones of the run, (n,); none if there is no such file."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        data = b""
    nothing = np.empty(0, dtype)
    if len(data) < _HEADER.size:
        return nothing
    magic, row_size, before = _HEADER.unpack_from(data)
    if magic != _MAGIC or row_size != dtype.itemsize or before > stored:
        return nothing
    count = (len(data) - _HEADER.size) // row_size
    rows: NDArray[np.void] = np.frombuffer(data, dtype, count, _HEADER.size)
    return rows[stored - before :]
