"""A logger for tests: its rings, its input line by line, its clock, and one that keeps what it is handed."""

import errno
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.loop.cycle_record import ROW
from servobench.hil.recording import logger as module
from servobench.hil.recording.log_files import FaultsKeeper, Keeper
from servobench.hil.recording.logger import Logger
from servobench.hil.recording.logger_process import LineReader
from servobench.hil.recording.ring import RingWriter
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.events import FaultEntries
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import Rows
from servobench.hil.rows.side_rows import EVENT, FRAME, RunEvent, event_row
from servobench.hil.verdict.summary import Summary
from servobench.virtual_bus.faults.fault_log import BLOCK, KIND_CODES
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.test_frame_keepers import blocks

ROWS, FRAMES, EVENTS, FAULTS = 4_096, 4, 8, 4
OUTCOME: Final = json.dumps(asdict(whole_outcome(0)))
NOTHING_KEPT: Final = replace(plan_for(Path()), folder=None)


class Kept(Keeper):
    """Notes what it is handed."""

    def __init__(self, name: str = "kept", fails_at: str = "") -> None:
        self.name = name
        self.calls: list[str] = []
        self.rows = self.frames = 0
        self.events: list[RunEvent] = []
        self.summary: Summary | None = None
        self._fails_at = fails_at

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:
        self.rows += rows.size
        self.frames += frames.size
        self.events += events
        self._called("take")

    def flush(self) -> None:
        self._called("flush")

    def finish(self, summary: Summary) -> None:
        self.summary = summary
        self._called("finish")

    def _called(self, what: str) -> None:
        self.calls.append(what)
        if what == self._fails_at:
            raise OSError(errno.ENOSPC, "no  room\nleft")


class Rings(NamedTuple):
    rows: RingWriter
    frames: RingWriter
    events: RingWriter
    faults: RingWriter

    @property
    def descriptors(self) -> list[int]:
        return [ring.descriptor for ring in self]

    def tell(self, *events: RunEvent) -> None:
        for event in events:
            self.events.push(event_row(event))

    def cycles(self, rows: Rows) -> None:
        for row in rows:
            self.rows.push(row.tobytes())


@contextmanager
def made_rings(rows: int, frames: int, events: int, faults: int) -> Iterator[Rings]:
    """Of so many rows each, powers of two."""
    sizes = ((ROW, rows), (FRAME, frames), (EVENT, events), (BLOCK, faults))
    found = Rings(*(RingWriter(row, capacity) for row, capacity in sizes))
    yield found
    for ring in found:
        ring.close()


@pytest.fixture
def rings() -> Iterator[Rings]:
    """Small ones, but for the rows."""
    with made_rings(ROWS, FRAMES, EVENTS, FAULTS) as found:
        yield found


class Clock:
    """The wall clock of the logger; its input lets the time pass."""

    def __init__(self) -> None:
        self.ns = 0

    def now(self) -> Instant:
        return Instant(self.ns)


Line = str | Callable[[], None] | None


class Input(LineReader):
    """A line for each question, or what happens before there is none."""

    def __init__(self, clock: Clock, lines: Sequence[Line], step_s: float = 0.1) -> None:
        self.ended = False
        self.waits: list[float] = []
        self._clock, self._lines, self._step_s = clock, iter(lines), step_s

    def line(self, timeout_s: float) -> str | None:
        self.waits.append(timeout_s)
        self._clock.ns += round(self._step_s * NS_PER_S)
        answer = next(self._lines, "end")
        if callable(answer):
            answer()
            return None
        self.ended = answer == "end"
        return None if self.ended else answer


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(module, "MonotonicClock", lambda: found)
    return found


@pytest.fixture
def keepers(monkeypatch: pytest.MonkeyPatch) -> list[Keeper]:
    """Those that a logger is given when it opens its files."""
    found: list[Keeper] = []

    def opened(plan: RecordingPlan, review: Review, entries: FaultEntries) -> list[Keeper]:
        del review
        if plan.folder is None or not plan.faults:
            return [*found]
        return [*found, FaultsKeeper(plan.folder, entries)]

    monkeypatch.setattr(module, "open_keepers", opened)
    return found


@pytest.fixture
def kept(keepers: list[Keeper]) -> Kept:
    keepers.append(Kept())
    return keepers[0]  # type: ignore[return-value]


def log(rings: Rings, source: Input, plan: RecordingPlan = NOTHING_KEPT) -> tuple[Summary, list[str]]:
    """The summary of a logger's run, and what it told the writer."""
    told: list[str] = []
    return Logger(plan, *rings.descriptors, tell=told.append).run(source), told


def put_faults(rings: Rings, *entries: Sequence[int]) -> None:
    """Entries as of :func:`blocks`."""
    for row in blocks(*entries):
        rings.faults.push(row.tobytes())


LOSS: Final = (KIND_CODES["loss"], 4 * NS_PER_MS, 0, 0x181, 4)
