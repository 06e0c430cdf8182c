"""What a run asks of whatever records it."""

from collections.abc import Callable
from typing import Protocol

from drivers.timebase import Instant
from drivers.wire.frame_port import FrameTap
from hil.loop.samples import CycleRecord
from hil.verdict.summary import Summary
from hil.verdict.verdict import RunOutcome


class RunRecorder(Protocol):
    """:class:`hil.recording.recorder.Recorder`, which says what each does, or one in memory."""

    @property
    def record(self) -> Callable[[CycleRecord], None]:
        """Takes one complete cycle of one axis."""
        ...

    def tap(self, segment: int = 0) -> FrameTap:
        """What takes the raw frames of a segment."""
        ...

    def begin(self, at: Instant) -> None:
        """The first cycle."""
        ...

    def event(self, at: Instant, level: str, text: str) -> None:
        """Something worth reading."""
        ...

    def state(self, at: Instant, track: str, label: str) -> None:
        """A track enters a state."""
        ...

    def identity(self, at: Instant, axis: str, text: str) -> None:
        """Who a drive is."""
        ...

    def load(self, at: Instant, axis: str, torque_nm: float, speed_rad_s: float) -> None:
        """What a load machine measured."""
        ...

    def fault_block(self, length: int, block: bytes) -> None:
        """Entries of the fault log."""
        ...

    def confirm(self, wait: Callable[[], None]) -> None:
        """Return when all until now is stored."""
        ...

    def trouble(self) -> str:
        """Why the run is not wholly recorded."""
        ...

    def close(self, outcome: RunOutcome) -> Summary:
        """End the recording."""
        ...
