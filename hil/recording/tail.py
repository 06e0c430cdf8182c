"""The rows that are not yet in records.arrow, as they came, so that they survive a logger that is killed.

A batch of columns is worth its room only from some thousand rows on; until one is full, its rows lie here.

    0   magic, row size       8 bytes, u64
    16  rows before these     u64, that records.arrow holds when this file begins anew
    24  rows
"""

import struct
from pathlib import Path

import numpy as np

from hil.recording.append_file import AppendFile
from hil.recording.records import ROW_DTYPE, Rows

TAIL_FILE = "records.tail"
_MAGIC = b"rowtail1"
_HEADER = struct.Struct("<8sQQ")


class Tail:
    """The writer's side."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / TAIL_FILE
        self._file = AppendFile(self._path)
        self.restart(0)

    def append(self, rows: Rows) -> None:
        """Keep ``rows``, (n,). Error: OSError if the disk is full."""
        self._file.write(rows.tobytes())

    def restart(self, stored: int) -> None:
        """records.arrow holds the first ``stored`` rows of the run, and so all that were here."""
        self._file.restart(_HEADER.pack(_MAGIC, ROW_DTYPE.itemsize, stored))

    def remove(self) -> None:
        """records.arrow is whole."""
        self._file.close()
        self._path.unlink()


def read_tail(folder: Path, stored: int) -> Rows:
    """The rows behind the first ``stored`` ones of the run, (n,); none if there is no such file."""
    try:
        data = (folder / TAIL_FILE).read_bytes()
    except FileNotFoundError:
        data = b""
    nothing = np.empty(0, ROW_DTYPE)
    if len(data) < _HEADER.size:
        return nothing
    magic, row_size, before = _HEADER.unpack_from(data)
    if magic != _MAGIC or row_size != ROW_DTYPE.itemsize or before > stored:
        return nothing
    count = (len(data) - _HEADER.size) // row_size
    rows: Rows = np.frombuffer(data, ROW_DTYPE, count, _HEADER.size)
    return rows[stored - before :]
