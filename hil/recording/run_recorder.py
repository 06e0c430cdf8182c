"""Interface between a run and its recorder."""

from abc import ABC, abstractmethod
from collections.abc import Callable

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import FrameTap
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.rows.side_rows import (
    BeginEvent,
    IdentityEvent,
    LoadEvent,
    RunEvent,
    StateEvent,
    TextEvent,
)
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import RunOutcome


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
