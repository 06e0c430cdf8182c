"""A recorder that keeps no files and starts no process: the figures of a run in this one."""

from collections.abc import Callable

import numpy as np

from drivers.timebase import Instant
from drivers.wire.frame_port import FrameTap
from hil.loop.samples import CycleRecord
from hil.reviewing.review import Review
from hil.rows.recording_plan import ReviewPlan
from hil.rows.records import ROW, ROW_DTYPE, row_of
from hil.rows.side_rows import LoadEvent, StateEvent, TextEvent
from hil.verdict.summary import Summary, summarise
from hil.verdict.verdict import RunOutcome

_REVIEWED_BYTES = 1024 * ROW.size


class MemoryRecorder:
    """As :class:`hil.recording.recorder.Recorder`, without frames."""

    def __init__(self, plan: ReviewPlan, seed: int = 0) -> None:
        self.events: list[TextEvent | StateEvent | LoadEvent] = []
        self._plan, self._seed = plan, seed
        self._review = Review(plan)
        self._rows = bytearray()

    def tap(self, segment: int = 0) -> FrameTap:  # noqa: ARG002
        return FrameTap()

    def begin(self, at: Instant) -> None:
        """Nothing depends on it here."""

    def record(self, record: CycleRecord) -> None:
        self._rows += row_of(record)
        if len(self._rows) == _REVIEWED_BYTES:
            self._review_filled()

    def frame(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        """Dropped."""

    def event(self, at: Instant, level: str, text: str) -> None:
        self.events.append(TextEvent(at, level, text))

    def state(self, at: Instant, track: str, label: str) -> None:
        self.events.append(StateEvent(at, track, label))

    def identity(self, at: Instant, axis: str, text: str) -> None:
        """Nobody reads it here."""

    def load(self, at: Instant, axis: str, torque_nm: float, speed_rad_s: float) -> None:
        self.events.append(LoadEvent(at, axis, torque_nm, speed_rad_s))

    def confirm(self, wait: Callable[[], None]) -> None:
        """Memory holds it."""

    def trouble(self) -> str:
        return ""

    def close(self, outcome: RunOutcome) -> Summary:
        self._review_filled()
        return summarise(self._review.figures(), outcome, self._plan.limits, "", self._seed)

    def _review_filled(self) -> None:
        self._review.add(np.frombuffer(bytes(self._rows), ROW_DTYPE))
        self.events += self._review.take_events()
        self._rows.clear()
