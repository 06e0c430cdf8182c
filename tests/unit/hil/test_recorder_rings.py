"""The writer's side of a recording with a test behind it: rings, their limits, and the run's folder."""

import errno
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.recording import recorder as module
from servobench.hil.recording.logger_process import RecordingFailed
from servobench.hil.recording.recorder import (
    EVENTS_CAPACITY,
    FAULTS_CAPACITY,
    FRAMES_CAPACITY,
    ROWS_CAPACITY,
    Recorder,
    recorder_of,
    start_recording,
)
from servobench.hil.recording.ring import RingReader
from servobench.hil.recording.run_recorder import MemoryRecorder
from servobench.hil.rows.events import BLOCK_DTYPE
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import ROW_DTYPE
from servobench.hil.rows.side_rows import EVENT_DTYPE, FRAME_DTYPE, BeginEvent, TextEvent, events_of
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import RunOutcome
from servobench.virtual_bus.faults.fault_log import BLOCK_BYTES
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records
from tests.unit.hil.test_report import summary

OUTCOME: Final = whole_outcome(4)
RECORDS: Final = list(synthetic_records(8))


class Logger:
    """In the place of the logger's process; it takes nothing unless it is told to."""

    process_id = 4711

    def __init__(self, plan: RecordingPlan, descriptors: Sequence[int]) -> None:
        self.plan = plan
        self.rings = [
            RingReader(descriptor, dtype)
            for descriptor, dtype in zip(
                descriptors, (ROW_DTYPE, FRAME_DTYPE, EVENT_DTYPE, BLOCK_DTYPE), strict=True
            )
        ]
        self.calls: list[object] = []
        self.gone = False
        self.said = ""
        self.summary: Summary | None = summary()

    def wait_ready(self) -> None:
        self.calls.append("ready")

    def confirm(self, wait: Callable[[], None]) -> None:
        self.calls.append(wait)

    def trouble(self) -> str:
        return self.said

    def finish(self, outcome: RunOutcome) -> Summary | None:
        self.calls.append(outcome)
        return self.summary


@pytest.fixture
def loggers(monkeypatch: pytest.MonkeyPatch) -> list[Logger]:
    """Those that were started; their rings are small ones."""
    found: list[Logger] = []

    def start(plan: RecordingPlan, descriptors: Sequence[int]) -> Logger:
        found.append(Logger(plan, descriptors))
        return found[-1]

    monkeypatch.setattr(module, "LoggerProcess", start)
    for number, name in enumerate(("ROWS", "FRAMES", "EVENTS", "FAULTS")):
        monkeypatch.setattr(module, f"{name}_CAPACITY", 4 << number)
    return found


Made = tuple[Recorder, Logger]


@pytest.fixture
def live(loggers: list[Logger], tmp_path: Path) -> Iterator[Made]:
    """In real time."""
    yield from made(plan_for(tmp_path, real_time=True), loggers)


@pytest.fixture
def simulated(loggers: list[Logger], tmp_path: Path) -> Iterator[Made]:
    yield from made(plan_for(tmp_path), loggers)


def made(plan: RecordingPlan, loggers: list[Logger]) -> Iterator[Made]:
    recorder = Recorder(plan)
    yield recorder, loggers[0]
    if OUTCOME not in loggers[0].calls:
        recorder.close(OUTCOME)


# ---- what goes into which ring ------------------------------------------------------------------------


def test_the_rings_hold_a_minute_at_1_khz() -> None:
    """Rows of one axis; in simulated time 8 frames a cycle, which a second axis has not yet."""
    assert 60_000 <= ROWS_CAPACITY < 70_000
    assert FRAMES_CAPACITY == 8 * ROWS_CAPACITY
    assert (EVENTS_CAPACITY, FAULTS_CAPACITY * 60) == (2_048, 245_760)


def test_everything_goes_into_its_ring(simulated: Made) -> None:
    recorder, logger = simulated
    rows, frames, events, faults = logger.rings
    recorder.record(RECORDS[0])
    recorder.tap(2).record(RECORDS[1])
    recorder.tap(2).frame("tx", 0x181, b"\x01", False, False, Instant(7))
    recorder.begin(Instant(5))
    recorder.event(Instant(6), "WARN", "x")
    recorder.fault_block(3, bytes(range(256)) * 20)
    assert rows.drain().tobytes() == rows_of(RECORDS[:2]).tobytes()
    (frame,) = frames.drain()
    assert (frame["at"], frame["can_id"], frame["length"], frame["sent"]) == (7, 0x181, 1, 2 * 2 + 1)
    assert events_of(events.drain()) == [BeginEvent(Instant(5)), TextEvent(Instant(6), "WARN", "x")]
    (block,) = faults.drain()
    assert block["length"] == 3
    assert block["block"].tobytes() == (bytes(range(256)) * 20)[:BLOCK_BYTES]
    assert (logger.plan, recorder.logger_process_id) == (recorder._plan, 4711)


@pytest.mark.parametrize(
    ("wish", "kept"), [({}, 1), ({"frames": False}, 0), ({"folder": None}, 0), ({"frames": True}, 1)]
)
def test_frames_are_kept_where_there_is_a_folder_and_the_plan_wants_them(
    loggers: list[Logger], tmp_path: Path, wish: dict[str, object], kept: int
) -> None:
    recorder = Recorder(replace(plan_for(tmp_path), **wish))  # type: ignore[arg-type]
    recorder.tap().frame("tx", 0x181, b"\x01", False, False, Instant(7))
    assert loggers[0].rings[1].drain()["sent"].tolist() == [1] * kept, "of the first segment"
    recorder.close(OUTCOME)


# ---- full rings ---------------------------------------------------------------------------------------


def test_in_real_time_rows_that_find_a_ring_full_are_lost_and_counted(live: Made) -> None:
    recorder, logger = live
    for record in RECORDS[:4]:
        recorder.record(record)
    assert recorder.trouble() == ""
    recorder.record(RECORDS[4])
    for _ in range(18):
        recorder.begin(Instant(0))
    assert recorder.trouble() == "3 rows lost, the logger was too slow"
    assert logger.rings[0].drain()["sequence"].tolist() == [1, 2, 3, 4]
    logger.said = "the disk is full"
    assert recorder.trouble() == "the disk is full", "the logger knows better"


class Clock:
    """Sleeping on it lets something happen."""

    def __init__(self, at_s: float, happens: Callable[[int], None]) -> None:
        self.ns = round(at_s * NS_PER_S)
        self.slept: list[int] = []
        self._happens = happens

    def now(self) -> Instant:
        return Instant(self.ns)

    def sleep_until(self, at: Instant) -> None:
        self.slept.append(at - self.ns)
        self.ns = at
        self._happens(len(self.slept))


def wait_by(monkeypatch: pytest.MonkeyPatch, happens: Callable[[int], None], at_s: float = 1_000.0) -> Clock:
    clock = Clock(at_s, happens)
    monkeypatch.setattr(module, "MonotonicClock", lambda: clock)
    return clock


def test_in_simulated_time_a_full_ring_waits_a_quarter_of_a_millisecond_at_a_time(
    simulated: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder, logger = simulated

    def drain(turn: int) -> None:
        if turn == 3:
            logger.rings[0].drain()

    clock = wait_by(monkeypatch, drain)
    for record in RECORDS:
        recorder.record(record)
    assert clock.slept == [NS_PER_MS // 4] * 3
    assert logger.rings[0].drain()["sequence"].tolist() == [5, 6, 7, 8]
    assert recorder.trouble() == ""


@pytest.mark.parametrize("turn", [1, 4])
def test_nobody_waits_for_a_logger_that_is_gone(
    simulated: Made, monkeypatch: pytest.MonkeyPatch, turn: int
) -> None:
    recorder, logger = simulated

    def die(now: int) -> None:
        logger.gone = now == turn

    clock = wait_by(monkeypatch, die)
    for record in RECORDS[:5]:
        recorder.record(record)
    assert len(clock.slept) == turn
    assert recorder.trouble() == "1 rows lost, the logger was too slow"


def test_a_logger_that_takes_nothing_for_a_minute_takes_nothing_any_more(
    simulated: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The minute begins when it is first waited for, and anew with each row that it takes, of any ring."""
    recorder, logger = simulated

    def look(turn: int) -> None:
        clock.ns += 30 * NS_PER_S
        if turn == 2:
            logger.rings[2].drain()

    recorder.begin(Instant(0))
    recorder.record(RECORDS[0])
    logger.rings[0].drain()
    clock = wait_by(monkeypatch, look)
    for record in RECORDS[1:6]:
        recorder.record(record)
    # waited for at 0 s, 30 s, at 60 s one more was taken, then at 90 s and 120 s, and it is given up at 150 s
    assert len(clock.slept) == 4
    assert recorder.trouble() == "1 rows lost, the logger was too slow"
    assert logger.rings[0].drain()["sequence"].tolist() == [2, 3, 4, 5]


def test_a_minute_is_waited_to_its_end(simulated: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder, _ = simulated

    def pass_by(_turn: int) -> None:
        clock.ns = 1_060 * NS_PER_S + len(clock.slept) - 1

    clock = wait_by(monkeypatch, pass_by)
    for record in RECORDS[:5]:
        recorder.record(record)
    assert len(clock.slept) == 2, "at 60 s it is still waited for, and 1 ns later no more"


# ---- the logger and the end ---------------------------------------------------------------------------


def test_what_is_asked_of_the_logger_is_passed_on(live: Made) -> None:
    recorder, logger = live
    wait: Callable[[], None] = lambda: None  # noqa: E731
    recorder.wait_ready()
    recorder.confirm(wait)
    assert logger.calls == ["ready", wait]
    assert recorder.close(OUTCOME) == summary()
    assert logger.calls[2:] == [OUTCOME]


def test_a_dead_logger_s_recording_is_salvaged_before_the_rings_are_given_up(
    loggers: list[Logger], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[object] = []

    def salvage(
        plan: RecordingPlan, descriptors: Sequence[int], outcome: RunOutcome, trouble: str
    ) -> Summary:
        calls.extend((plan, outcome, trouble))
        calls.append([os.fstat(descriptor).st_size > 0 for descriptor in descriptors])
        open_rings.extend(descriptors)
        return summary()

    open_rings: list[int] = []
    monkeypatch.setattr(module, "salvage", salvage)
    plan = plan_for(tmp_path)
    recorder = Recorder(plan)
    loggers[0].summary, loggers[0].said = None, "it died"
    assert recorder.close(OUTCOME) == summary()
    assert calls == [plan, OUTCOME, "it died", [True] * 4]
    for descriptor in open_rings:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(descriptor)


def test_without_a_folder_a_dead_logger_s_figures_are_lost(loggers: list[Logger]) -> None:
    recorder = Recorder(replace(plan_for(Path()), folder=None))
    loggers[0].summary, loggers[0].said = None, "it died"
    descriptors = [ring.descriptor for ring in recorder._rings]
    with pytest.raises(RecordingFailed) as caught:
        recorder.close(OUTCOME)
    assert caught.value.trouble == "it died"
    for descriptor in descriptors:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(descriptor)


# ---- beginning ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wish", "process"),
    [({}, False), ({"view": True}, True), ({"real_time": True}, True), ({"folder": Path("run")}, True)],
)
def test_a_run_of_which_nothing_is_kept_or_shown_needs_no_process(
    loggers: list[Logger],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    wish: dict[str, object],
    process: bool,
) -> None:
    monkeypatch.chdir(tmp_path)
    recorder = recorder_of(replace(plan_for(Path()), **{"folder": None, **wish}))  # type: ignore[arg-type]
    assert (isinstance(recorder, Recorder), isinstance(recorder, MemoryRecorder)) == (process, not process)
    assert len(loggers) == process
    if process:
        assert loggers[0].calls == (["ready"] if "real_time" in wish else [])
        recorder.close(OUTCOME)


def test_a_recording_begins_in_a_new_folder_with_its_bench(loggers: list[Logger], tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    start_recording(plan_for(folder)).close(OUTCOME)
    assert [path.name for path in folder.iterdir()] == ["bench.toml"]
    assert (folder / "bench.toml").read_text() == "# resolved\n"
    assert len(loggers) == 1


def refused(folder: Path) -> str:
    with pytest.raises((BadInput, RecordingFailed)) as caught:
        start_recording(plan_for(folder))
    return str(caught.value)


def test_a_folder_that_is_no_new_one_is_refused_before_anything_is_started(
    loggers: list[Logger], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    assert refused(tmp_path) == (
        f"--record: found '{tmp_path}', expected a new or empty folder; a recording is never overwritten"
    )
    place = tmp_path / "file" / "run"
    assert refused(place) == (
        f"--record: found '{place}', expected a folder that can be made; "
        f"[Errno 20] Not a directory: '{place}'"
    )
    assert loggers == []


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOSPC, "No space left on device"),
        (errno.EDQUOT, "Disk quota exceeded"),
        (errno.EIO, "Input/output error"),
    ],
)
def test_a_full_disk_is_no_mistake_of_the_caller(
    loggers: list[Logger], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    def fail(*_arguments: object, **_options: object) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "mkdir", fail)
        assert refused(tmp_path / "run") == f"not recorded: {tmp_path / 'run'}: {words}"
    monkeypatch.setattr(Path, "write_text", fail)
    assert refused(tmp_path / "run") == f"not recorded: {tmp_path / 'run' / 'bench.toml'}: {words}"
    assert loggers == []
