"""Rows that are not yet in their file, as they came, so that they survive a logger that is killed.

Rows of cycles wait until there are enough for a batch of columns, frames until no earlier one can come.

    0   magic, row size       8 bytes, u64
    16  rows before these     u64, that the file holds when this one begins anew
    24  rows
"""

import struct
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.hil.recording.append_file import AppendFile

TAIL_FILE: Final = "records.tail"
FRAMES_TAIL_FILE: Final = "frames.tail"
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
