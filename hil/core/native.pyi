"""hil's core, written in C, as seen from Python; the sources beside this file document it."""

from collections.abc import Callable
from typing import Self

from servobench.drivers.core.native import WireFrame
from servobench.drivers.timebase import Instant
from servobench.hil.loop.syncs import SyncMark

SOURCES_DIGEST: str
"""Digest of the C sources of the core (servobench.design.core.build)."""

def frame_row(at: int, can_id: int, sent: int, data: bytes, /) -> bytes:
    """A row of servobench.hil.rows.side_rows.FRAME; ``can_id`` with its flags
    (servobench.drivers.wire.frame_port).

    Error: ValueError for what does not fit into one.
    """

class Ring:
    """The writer's end of a ring of rows in shared memory (servobench.hil.recording.ring)."""

    def __new__(cls, descriptor: int, row_bytes: int, capacity: int, on_full: Callable[[], bool], /) -> Self:
        """``descriptor``: of an empty file in memory. ``capacity``: rows, a power of two. ``on_full``: asked
        while full; True: look again. Error: ValueError, OSError without memory."""

    def push(self, row: bytes, /) -> bool:
        """Store one row; False: the ring is full, it is refused. Error: ValueError for another size."""

    @property
    def refused(self) -> int:
        """Rows that found the ring full."""

    @property
    def taken(self) -> int:
        """Rows whose room the reader has given back."""

    def close(self) -> None:
        """Give up the writer's hold; the reader keeps what is there."""

class FrameSink:
    """Frames of a link as rows of a ring (servobench.hil.rows.side_rows.FRAME)."""

    def __new__(cls, ring: Ring | None, segment: int, /) -> Self:
        """``ring``: None keeps nothing. ``segment``: its number. Error: ValueError above 127."""

    @property
    def way(self) -> object:
        """A capsule by which a link shows its frames (design/core/frames.h)."""

    def show(self, frame: WireFrame, sent: bool, at: Instant, /) -> None:
        """The same from Python."""

class RegularStream:
    """A regular stream of frames: their places are ``step`` apart, within ``tolerance``."""

    def __new__(
        cls, step: int, tolerance: int, least: int, period: int, repeats: bool, same: bool, /
    ) -> Self:
        """``least``: regular frames before an extra one. ``period``: of the SYNCs that are answered.
        ``repeats``: frames are all alike. ``same``: the regular frame after an extra one must be as the one
        before. Error: ValueError below 0."""
    seen: int
    """Place of the SYNC that the newest frame of ``compare`` answers."""
    least: int
    held: bool
    """True if a missing frame may have been held back, and still come."""
    doubled: bool
    """Since this was last set back there was more than one frame where one was due."""

    @property
    def repetitions(self) -> int:
        """Frames too many that may be repetitions of one before; in a network that repeats frames, all that
        equal one of the last."""

    def trust(self, place: int, /) -> None:
        """Expect the frame at ``place`` next: nothing was ever lost."""

    def take(self, place: int, delay: int, data: bytes, at: int, /) -> list[tuple[Instant, bytes]]:
        """Take a frame, ``delay`` after what it answers; return the surplus ones before it."""

    def compare(
        self, frames: bytes, marks: list[SyncMark], until: int, /
    ) -> tuple[list[tuple[Instant, bytes]], int]:
        """Take ``frames``, rows as an Inlet keeps them, as answers to the SYNCs ``marks``, in order of
        their places; return the surplus ones, and how many were taken. Those from ``until`` on wait for the
        next call, 128 at most."""

    def end(self) -> list[tuple[Instant, bytes]]:
        """End the stream: frames since the last regular one are surplus."""
