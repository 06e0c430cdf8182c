"""What the logger hands to those that keep something, and when."""

from dataclasses import replace
from pathlib import Path

import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.loop.cycle_record import ROW
from servobench.hil.recording.log_files import Keeper
from servobench.hil.recording.logger import Logger
from servobench.hil.rows.recording_plan import PlannedSetPoint, ServedPorts
from servobench.hil.rows.side_rows import (
    FRAME,
    BeginEvent,
    RunEvent,
    StateEvent,
    TextEvent,
    event_row,
    frame_row,
)
from servobench.virtual_bus.faults.fault_log import BLOCK, KIND_CODES
from tests.unit.hil.logger_fakes import (
    EVENTS,
    FAULTS,
    FRAMES,
    LOSS,
    NOTHING_KEPT,
    OUTCOME,
    ROWS,
    Clock,
    Input,
    Kept,
    Rings,
    clock,
    keepers,
    kept,
    log,
    put_faults,
    rings,
)
from tests.unit.hil.row_tools import plain_rows

__all__ = ["clock", "keepers", "kept", "rings"]


# ---- when it drains -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "wait_s"), [(0, 0.1), (2_000, 0.1), (2_001, 0.0)])
def test_a_drain_that_found_much_is_followed_by_the_next_at_once(
    rings: Rings, kept: Kept, clock: Clock, count: int, wait_s: float
) -> None:
    source = Input(clock, [lambda: rings.cycles(plain_rows(count)), None, OUTCOME])
    summary, told = log(rings, source)
    assert source.waits == [0.1, wait_s, 0.1]
    assert (kept.rows, summary.cycles, told) == (count, count, [])


@pytest.mark.parametrize(
    ("view", "served", "files", "wait_s"),
    [
        (False, None, False, 1.0),
        (False, None, True, 0.2),
        (True, None, False, 0.1),
        (True, None, True, 0.1),
        (False, ServedPorts(0, 0), True, 0.1),
    ],
)
def test_in_real_time_it_drains_more_rarely_unless_somebody_looks_on(
    rings: Rings,
    kept: Kept,
    clock: Clock,
    tmp_path: Path,
    view: bool,
    served: ServedPorts | None,
    files: bool,
    wait_s: float,
) -> None:
    folder = tmp_path if files else None
    plan = replace(NOTHING_KEPT, real_time=True, view=view, served=served, folder=folder)
    source = Input(clock, [None, OUTCOME])
    log(rings, source, plan)
    assert source.waits == [wait_s, wait_s]
    assert kept.calls.count("take") == 3


@pytest.mark.parametrize(("step_s", "flushes"), [(0.1, 1), (0.25, 2), (0.24, 1), (1.0, 5), (0.999, 3)])
def test_files_are_brought_to_the_disk_once_a_second_and_at_the_end(
    rings: Rings, kept: Kept, clock: Clock, step_s: float, flushes: int
) -> None:
    """Four questions, so long apart; the last of the flushes is that of the end."""
    log(rings, Input(clock, [None, None, None, OUTCOME], step_s))
    assert kept.calls.count("flush") == flushes
    assert kept.calls[-2:] == ["flush", "finish"]


def test_a_second_is_counted_from_the_last_flush(rings: Rings, kept: Kept, clock: Clock) -> None:
    """A confirmation flushes too: at 0.6 s, then not before 1.6 s."""
    log(rings, Input(clock, [None, "confirm", None, OUTCOME], 0.3))
    drained = ["take", "take", "flush", "take", "take", "take"]
    assert kept.calls == [*drained, "take", "flush", "finish"]


def test_what_was_there_at_a_question_is_stored_before_the_answer(
    rings: Rings, kept: Kept, clock: Clock
) -> None:
    told: list[tuple[str, int, list[str]]] = []

    def tell(line: str) -> None:
        told.append((line, kept.rows, [*kept.calls]))

    logger = Logger(NOTHING_KEPT, *rings.descriptors, tell=tell)
    rings.cycles(plain_rows(3))
    logger.run(Input(clock, ["confirm", "confirm", OUTCOME]))
    assert told == [
        ("stored", 3, ["take", "flush"]),
        ("stored", 3, ["take", "flush", "take", "take", "flush"]),
    ]


def test_what_comes_between_the_last_question_and_the_outcome_is_taken(
    rings: Rings, kept: Kept, clock: Clock
) -> None:
    class Late(Input):
        def line(self, timeout_s: float) -> str | None:
            answer = super().line(timeout_s)
            rings.cycles(plain_rows(1))
            return answer

    assert log(rings, Late(clock, [OUTCOME]))[0].cycles == kept.rows == 1


# ---- what it hands on -----------------------------------------------------------------------------------


def test_rows_frames_and_events_go_to_every_keeper_each_time(
    rings: Rings, keepers: list[Keeper], clock: Clock
) -> None:
    both = [Kept(), Kept()]
    keepers += both
    rings.cycles(plain_rows(5))
    rings.frames.push(frame_row(Instant(0), 0x80, 1, b""))
    later, sooner = TextEvent(Instant(9), "INFO", "later"), StateEvent(Instant(8), "phase", "running")
    rings.tell(BeginEvent(Instant(0)), later, sooner)
    summary, _ = log(rings, Input(clock, [OUTCOME]))
    for keeper in both:
        assert (keeper.rows, keeper.frames) == (5, 1)
        assert keeper.events == [BeginEvent(Instant(0)), sooner, later], "in order of time"
        assert keeper.calls == ["take", "take", "flush", "finish"]
        assert keeper.summary == summary


def test_set_points_count_from_the_first_cycle_that_came_with_their_row(
    rings: Rings, kept: Kept, clock: Clock
) -> None:
    begin = Instant(NS_PER_S)
    rows = plain_rows(5)
    rows["due_at"] += begin
    rows["command_handed_at"] = rows["due_at"] + 7
    rings.cycles(rows)
    rings.tell(BeginEvent(begin))
    planned = (PlannedSetPoint(Duration(2 * NS_PER_MS), 0, "now 100 r/min"),)
    log(rings, Input(clock, [OUTCOME]), replace(NOTHING_KEPT, set_points=planned))
    handed_at = Instant(begin + 2 * NS_PER_MS + 7)
    assert kept.events == [BeginEvent(begin), TextEvent(handed_at, "INFO", "now 100 r/min")]


def test_a_fault_s_window_is_closed_at_the_end_and_not_before(rings: Rings, kept: Kept, clock: Clock) -> None:
    before: list[RunEvent] = []
    rings.tell(BeginEvent(Instant(5)))
    put_faults(rings, LOSS)
    log(rings, Input(clock, [None, None, lambda: before.extend(kept.events), OUTCOME]))
    at = Instant(5 + 4 * NS_PER_MS)
    first, *opened = before
    assert first == BeginEvent(Instant(5))
    assert [(event.at, type(event)) for event in opened] == [(at, TextEvent), (at, StateEvent)]
    closed = kept.events[len(before) :]
    assert [(event.at, type(event)) for event in closed] == [(at, TextEvent), (at, StateEvent)]
    assert [event.label for event in kept.events if isinstance(event, StateEvent)] == ["active", "-"]


def test_faults_of_a_run_without_a_cycle_are_told_at_its_end(rings: Rings, kept: Kept, clock: Clock) -> None:
    before: list[RunEvent] = []
    put_faults(rings, LOSS)
    log(rings, Input(clock, [None, None, lambda: before.extend(kept.events), OUTCOME]))
    assert before == []
    assert [event.label for event in kept.events if isinstance(event, StateEvent)] == ["active", "-"]


@pytest.mark.parametrize(("last_cycle_ms", "over_at"), [(None, None), (59, None), (60, 60), (70, 60)])
def test_a_node_s_fault_is_over_once_the_run_has_come_so_far(
    rings: Rings, kept: Kept, clock: Clock, last_cycle_ms: int | None, over_at: int | None
) -> None:
    """Bus off from 10 ms to 60 ms; the last event is of 20 ms, and one that came after it of 1 ms."""
    rings.tell(BeginEvent(Instant(0)), TextEvent(Instant(20 * NS_PER_MS), "INFO", "x"))
    put_faults(rings, (KIND_CODES["bus_off"], 10 * NS_PER_MS, 3, 0, 0, 50 * NS_PER_MS))
    if last_cycle_ms is not None:
        rings.cycles(plain_rows(last_cycle_ms + 1))
    log(rings, Input(clock, [None, lambda: rings.tell(TextEvent(Instant(NS_PER_MS), "INFO", "y")), OUTCOME]))
    states = [(event.at // NS_PER_MS, event.label) for event in kept.events if isinstance(event, StateEvent)]
    assert states == [(10, "active"), *([] if over_at is None else [(over_at, "-")])]


@pytest.mark.parametrize("events_first", [True, False])
def test_how_far_a_run_has_come_is_never_taken_back(
    rings: Rings, kept: Kept, clock: Clock, events_first: bool
) -> None:
    """An event of 100 ms, and a bus off that ends at 60 ms and is told of in the next drain."""

    def strike() -> None:
        rings.tell(TextEvent(Instant(NS_PER_MS), "INFO", "y"))
        put_faults(rings, (KIND_CODES["bus_off"], 10 * NS_PER_MS, 3, 0, 0, 50 * NS_PER_MS))

    late = TextEvent(Instant(100 * NS_PER_MS), "INFO", "x")
    rings.tell(BeginEvent(Instant(0)), *([late, BeginEvent(Instant(0))] if events_first else [late]))
    log(rings, Input(clock, [None, strike, OUTCOME]))
    states = [(event.at // NS_PER_MS, event.label) for event in kept.events if isinstance(event, StateEvent)]
    assert states == [(10, "active"), (60, "-")]


# ---- what is lost -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ring", "capacity", "row", "one", "more"),
    [
        ("rows", ROWS, bytes(ROW.size), "cycle record", "cycle records"),
        ("frames", FRAMES, bytes(FRAME.size), "frame", "frames"),
        ("events", EVENTS, event_row(BeginEvent(Instant(0))), "event", "events"),
        ("faults", FAULTS, bytes(BLOCK.size), "block of injected faults", "blocks of injected faults"),
    ],
    ids=["rows", "frames", "events", "faults"],
)
@pytest.mark.parametrize("lost", [0, 1, 2])
def test_what_found_a_ring_full_is_counted(
    rings: Rings,
    kept: Kept,
    clock: Clock,
    ring: str,
    capacity: int,
    row: bytes,
    one: str,
    more: str,
    lost: int,
) -> None:
    for _ in range(capacity + lost):
        getattr(rings, ring).push(row)
    summary, told = log(rings, Input(clock, [OUTCOME]))
    text = f"{lost} {more if lost > 1 else one} lost, the logger was too slow"
    assert summary.recording_faults == ((text,) if lost else ())
    assert told == ([f"failed {text}"] if lost else [])
    assert kept.summary == summary
