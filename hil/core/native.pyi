"""hil's core, written in C, as seen from Python; the sources beside this file document it."""

from collections.abc import Callable
from typing import Self

SOURCES_DIGEST: str
"""Digest of the C sources of the core (servobench.design.core.build)."""

def frame_row(at: int, can_id: int, sent: int, data: bytes, /) -> bytes:
    """A row of servobench.hil.rows.side_rows.FRAME; ``can_id`` with its flags
    (servobench.drivers.wire.identifiers).

    Error: ValueError for what does not fit into one.
    """

class Ring:
    """The writer's end of a ring of rows in shared memory (servobench.hil.recording.ring)."""

    def __new__(cls, descriptor: int, row_bytes: int, capacity: int, on_full: Callable[[], bool], /) -> Self:
        """``descriptor``: of an empty file in memory. ``capacity``: rows, a power of two. ``on_full``: asked
        while full; True: look again. Error: ValueError, OSError without memory."""

    def push(self, row: bytes, /) -> bool:
        """Store one row; False: the ring is full, it is refused. Error: ValueError for another size."""

    def push_frame(self, at: int, can_id: int, sent: int, data: bytes, /) -> bool:
        """The same of :func:`frame_row`."""

    @property
    def refused(self) -> int:
        """Rows that found the ring full."""

    @property
    def taken(self) -> int:
        """Rows whose room the reader has given back."""

    def close(self) -> None:
        """Give up the writer's hold; the reader keeps what is there."""
