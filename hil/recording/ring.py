"""A ring of fixed-size rows in anonymous shared memory: one writer, one reader, no lock between them.

    header   0  row size, bytes          u64
             8  capacity, rows           u64, a power of two
            64  rows written, ever       u64, written by the writer alone
           128  rows read, ever          u64, written by the reader alone
           192  rows refused, ever       u64, written by the writer alone
    rows   256  capacity x row size

The two counters lie on cache lines of their own. A row is stored before its count, so the
reader never sees half a row, also when the writer is killed in between; the memory lives
as long as either process holds its descriptor. The writer's end is C (core/ring.c).
"""

import fcntl
import mmap
import os
import struct
import threading
from collections.abc import Callable
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from servobench.hil.core.native import Ring

_HEADER_BYTES: Final = 256
_ROW_SIZE: Final = 0
_CAPACITY: Final = 1
_WRITTEN: Final = 8
_READ: Final = 16
_REFUSED: Final = 24
"""Places of the header's words, in units of 8 bytes; core/ring.h has them in bytes."""


class _Fence:
    """Orders memory accesses before it against those after it.

    The interpreter has no fence of its own; releasing and taking a lock is one, since it
    is a release followed by an acquire.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def pass_through(self) -> None:
        self._lock.release()
        self._lock.acquire()


def refuse() -> bool:
    """Policy of a full ring in real time: do not wait, count the row as refused."""
    return False


def _above_standard(descriptor: int) -> int:
    """The same file under a number above those of the standard streams.

    Code of the user's may have closed one of these, and the process that inherits a ring has pipes there.
    """
    if descriptor > 2:
        return descriptor
    try:
        return fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 3)
    finally:
        os.close(descriptor)


class RingWriter(Ring):
    """Makes the ring. ``push`` stores one row; it never waits unless ``on_full`` does."""

    descriptor: int

    def __new__(cls, row: struct.Struct, capacity: int, on_full: Callable[[], bool] = refuse) -> Self:
        """``capacity``: rows, a power of two. ``on_full``: asked while full; True: look again."""
        descriptor = _above_standard(os.memfd_create("servobench-ring", os.MFD_CLOEXEC))
        try:
            self = super().__new__(cls, descriptor, row.size, capacity, on_full)
        except BaseException:
            os.close(descriptor)
            raise
        self.descriptor = descriptor
        return self

    def close(self) -> None:
        """Give up the writer's hold; the reader keeps what is there."""
        super().close()
        os.close(self.descriptor)


class RingReader:
    """The other end, usually in another process that inherited ``descriptor``."""

    def __init__(self, descriptor: int, dtype: np.dtype[np.void]) -> None:
        size = os.fstat(descriptor).st_size
        self._memory = mmap.mmap(descriptor, size, flags=mmap.MAP_SHARED)
        self._words = memoryview(self._memory)[:_HEADER_BYTES].cast("Q")
        row_size, self._capacity = self._words[_ROW_SIZE], self._words[_CAPACITY]
        if row_size != dtype.itemsize:
            raise ValueError(f"the ring's rows have {row_size} bytes, expected {dtype.itemsize}")
        self._rows: NDArray[np.void] = np.frombuffer(
            self._memory, dtype, count=self._capacity, offset=_HEADER_BYTES
        )
        self._read = self._words[_READ]
        self._looked = self._read
        self._fence = _Fence()

    def drain(self) -> NDArray[np.void]:
        """A copy of all rows that are there, in order, (n,); their room is the writer's again."""
        found = self.look()
        self.release()
        return found

    def look(self) -> NDArray[np.void]:
        """The same, but their room is given back by :meth:`release` only: when they are stored elsewhere."""
        written = self._words[_WRITTEN]
        self._fence.pass_through()  # the count before the rows
        self._looked = written
        first, last = self._read % self._capacity, written % self._capacity
        if written == self._read:
            return self._rows[:0].copy()
        if first < last:
            found = self._rows[first:last].copy()
        else:
            found = np.concatenate((self._rows[first:], self._rows[:last]))
        return found

    def release(self) -> None:
        """The rows of the last :meth:`look` are not needed here any more."""
        self._fence.pass_through()  # the rows before their room is given back
        self._words[_READ] = self._read = self._looked

    @property
    def released(self) -> int:
        """Rows whose room was given back, ever."""
        return self._read

    @property
    def refused(self) -> int:
        """Rows that found the ring full."""
        return self._words[_REFUSED]
