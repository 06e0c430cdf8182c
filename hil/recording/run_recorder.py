"""Interface between a run and its recorder.

A recorder that keeps no files and starts no process: figures and digest of a run, made in this one.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import FrameTap
from servobench.hil.core.native import FrameSink
from servobench.hil.loop.cycle_record import ROW, CycleRecord, row_of
from servobench.hil.recording.run_metadata import run_metadata
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.events import BLOCK_DTYPE, FaultEntries, InjectedFaults, RunZero
from servobench.hil.rows.recording_plan import RecordingPlan, SetPointTeller
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.side_rows import (
    BeginEvent,
    IdentityEvent,
    LoadEvent,
    RunEvent,
    StateEvent,
    TextEvent,
    drives_of,
)
from servobench.hil.verdict.summary import Summary, summarise
from servobench.hil.verdict.verdict import RunOutcome
from servobench.virtual_bus.faults.fault_log import BLOCK

if TYPE_CHECKING:
    import pyarrow as pa


class RunRecorder(ABC):
    """Files by another process (:mod:`servobench.hil.recording.recorder`), or memory."""

    record: Callable[[CycleRecord], None]
    """Takes one complete cycle of one axis; each axis in order of sequence."""

    @abstractmethod
    def tap(self, segment: int = 0) -> FrameTap:
        """Return the tap for raw frames of the link to a segment, the first or another one."""

    @abstractmethod
    def tell(self, event: RunEvent) -> None:
        """Take what the methods below say."""

    def begin(self, at: Instant) -> None:
        """The run's time zero: the instant of the first cycle. Events before it get negative times."""
        self.tell(BeginEvent(at))

    def event(self, at: Instant, level: str, text: str) -> None:
        """Something worth reading. ``level``: "INFO", "WARN", "ERROR" or "CRITICAL"."""
        self.tell(TextEvent(at, level, text))

    def state(self, at: Instant, track: str, label: str) -> None:
        """``track`` (e.g. "phase") is in state ``label`` from ``at`` on.

        The tracks "AXIS drive" and "AXIS link" follow from the records by themselves while the
        loop runs; before and after it they are the caller's.
        """
        self.tell(StateEvent(at, track, label))

    def identity(self, at: Instant, axis: str, text: str) -> None:
        """Who the drive of an axis is, as it told."""
        self.tell(IdentityEvent(at, axis, text))

    def load(self, at: Instant, axis: str, torque_nm: float, speed_rad_s: float) -> None:
        """Record a measurement of an axis' load machine; a few dozen times a second at most."""
        self.tell(LoadEvent(at, axis, torque_nm, speed_rad_s))

    @abstractmethod
    def fault_block(self, length: int, block: bytes) -> None:
        """A block of entries, of which ``length`` bytes are filled; fits ``FaultLog.send_to``."""

    @abstractmethod
    def confirm(self, wait: Callable[[], None]) -> None:
        """Return when all that was recorded until now is stored; ``wait`` lets a little time pass.

        Error: RecordingFailed.
        """

    @abstractmethod
    def trouble(self) -> str:
        """Why the run is not wholly recorded, as far as is known; empty if it is. Does not wait."""

    @abstractmethod
    def close(self, outcome: RunOutcome) -> Summary:
        """End the recording and return its summary. Error: RecordingFailed if there is none."""


_REVIEWED_BYTES = 1024 * ROW.size
"""A review of so many rows costs little more than one of a single row."""


class KeptFrame(NamedTuple):
    """A frame as a tap sees it."""

    direction: str
    can_id: int
    data: bytes
    extended: bool
    remote: bool
    at: Instant


class _FrameKeeper(FrameTap):
    def __init__(self) -> None:
        self.frames: list[KeptFrame] = []

    def frame(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        self.frames.append(KeptFrame(direction, can_id, bytes(data), extended, remote, at))


class MemoryRecorder(RunRecorder):
    """In bounded memory, unless all is kept."""

    def __init__(self, plan: RecordingPlan, *, keep_all: bool = False) -> None:
        """``keep_all``: for :meth:`rows`, :meth:`table`, :meth:`frames` and :meth:`told`."""
        self.events: list[RunEvent] = []
        """In the order in which they came to be known."""
        self._plan, self._keep_all = plan, keep_all
        self._review = Review(plan.review)
        self._rows = bytearray()
        self._kept: list[bytes] = []
        self._taps: list[_FrameKeeper] = []
        self._blocks = bytearray()
        self._zero = RunZero(plan.started_at)

    def tap(self, segment: int = 0) -> FrameTap:
        """Frames of all segments alike; dropped, unless all is kept."""
        if not self._keep_all:
            dropped = FrameTap()
            dropped.native = FrameSink(None, segment)  # a call of Python's for each frame: 2 % of a run
            return dropped
        self._taps.append(_FrameKeeper())
        return self._taps[-1]

    def tell(self, event: RunEvent) -> None:
        """See :class:`servobench.hil.recording.run_recorder.RunRecorder`, as of the methods below."""
        self.events.append(event)
        self._zero.look([event])

    def record(self, record: CycleRecord) -> None:
        """A row; it is reviewed with others."""
        self._rows += row_of(record)
        if len(self._rows) == _REVIEWED_BYTES:
            self._review_filled()

    def fault_block(self, length: int, block: bytes) -> None:
        """Entries of injected faults."""
        if self._keep_all:
            self._blocks += BLOCK.pack(length, block)

    def confirm(self, wait: Callable[[], None]) -> None:
        """Memory holds it."""

    def trouble(self) -> str:
        """There is none."""
        return ""

    def close(self, outcome: RunOutcome) -> Summary:
        """The summary."""
        self._review_filled()
        return summarise(self._review.figures(), outcome, self._plan.review.limits, "", self._plan.seed)

    def rows(self) -> Rows:
        """(n,) of ROW_DTYPE on the bench's clock, in order of recording."""
        return np.frombuffer(b"".join(self._kept), ROW_DTYPE)

    def table(self) -> "pa.Table":
        """The same as ``records.arrow`` has it: in run time, with nulls, units and metadata."""
        from servobench.hil.rows.records_file import records_table  # pyarrow, which no loop needs

        metadata = run_metadata(self._plan, self._zero.at, drives_of(self.events))
        return records_table(self.rows(), metadata, self._zero.at)

    def frames(self) -> list[KeptFrame]:
        """Every frame in order of time, in run time."""
        tapped = [frame for tap in self._taps for frame in tap.frames]
        zero = self._zero.at
        shifted = [frame._replace(at=Instant(frame.at - zero)) for frame in tapped]
        return sorted(shifted, key=lambda frame: frame.at)

    def told(self) -> tuple[list[RunEvent], Instant]:
        """All that ``events.jsonl`` would tell, in order of time; and the first cycle."""
        return sorted([*self.events, *self._shown()], key=lambda event: event.at), self._zero.at

    def _shown(self) -> Iterator[RunEvent]:
        """Return the events that only rows and entries of the fault log show."""
        yield from SetPointTeller(self._plan.set_points).take(self.rows(), self._zero.at)
        injected = InjectedFaults()
        blocks = np.frombuffer(bytes(self._blocks), BLOCK_DTYPE)
        entries = FaultEntries(self._plan.started_at).take(blocks, self._zero, at_end=True)
        yield from injected.take(entries, self._zero.at)
        yield from injected.ended(max([event.at for event in self.events], default=self._zero.at))
        yield from injected.finish()

    def _review_filled(self) -> None:
        filled = bytes(self._rows)
        self._rows.clear()
        self._review.add(np.frombuffer(filled, ROW_DTYPE))
        self.events += self._review.take_events()
        if self._keep_all:
            self._kept.append(filled)
