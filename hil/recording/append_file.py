"""A file that grows at its end and has no half entries there, also when the disk is full."""

import os
from pathlib import Path


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
