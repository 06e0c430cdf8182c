"""What was injected, as events: windows of strikes, faults of nodes, and what is kept in memory of them."""

from pathlib import Path
from typing import Final

import pytest

from servobench.drivers.canopen.nmt import Emergency
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.recording.fault_report import last_frames, write_fault_report
from servobench.hil.recording.run_recorder import KeptFrame, MemoryRecorder
from servobench.hil.rows.events import InjectedFaults
from servobench.hil.rows.side_rows import BeginEvent, StateEvent, TextEvent
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.fault_log import AT_NODE, KIND_CODES, FaultEntry
from servobench.virtual_bus.faults.fault_table import NONE
from tests.recorded_frames import write_frames
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records

ZERO: Final = Instant(1_000 * NS_PER_MS)
DOWN: Final = int(Direction.HOST_TO_DRIVE)
UP: Final = int(Direction.DRIVE_TO_HOST)


def entry(kind: str, at_ms: float, link: int = DOWN, a: int = 0, can_id: int = 0x181) -> FaultEntry:
    return FaultEntry(round(at_ms * NS_PER_MS), a, 0, 0, can_id, 0, KIND_CODES[kind], link)


def told(*events: TextEvent | StateEvent) -> list[tuple[float, str, str]]:
    """Instants in ms of run time, level or track, and text or state."""
    return [((event.at - ZERO) / NS_PER_MS, event[1], event[2]) for event in events]


@pytest.mark.parametrize(
    ("kind", "link", "what", "first"),
    [
        ("loss", DOWN, "loss host to drive", "first frame 181h"),
        ("periodic_loss", UP, "periodic loss drive to host", "first frame 181h"),
        ("loss", UP + 3 * AT_NODE, "loss drive to host at node 3", "first frame 181h"),
        ("late", 3, "late, node 3", "first frame 181h"),
        ("host_stall", 0, "host stall", "first by 2.5 ms"),
    ],
)
def test_strikes_in_a_row_are_a_window(kind: str, link: int, what: str, first: str) -> None:
    faults = InjectedFaults()
    strikes = [entry(kind, at_ms, link, a=2_500_000) for at_ms in (10, 510, 1010)]
    track = f"injected {kind.replace('_', ' ')}: {what}"
    assert told(*faults.take(strikes[:1], ZERO)) == [
        (10.0, "WARN", f"injected from here: {what}, {first}"),
        (10.0, track, "active"),
    ]
    assert faults.take(strikes[1:], ZERO) == []
    assert told(*faults.finish()) == [
        (1010.0, "INFO", f"injected until here: {what}, 3 times within 1000 ms"),
        (1010.0, track, "-"),
    ]
    assert faults.finish() == []


def test_half_a_second_without_a_strike_ends_a_window() -> None:
    faults = InjectedFaults()
    found = faults.take([entry("loss", 10), entry("loss", 510.000001)], ZERO)
    what, track = "loss host to drive", "injected loss: loss host to drive"
    assert [(round(at, 3), level, text) for at, level, text in told(*found)] == [
        (10.0, "WARN", f"injected from here: {what}, first frame 181h"),
        (10.0, track, "active"),
        (10.0, "INFO", f"injected until here: {what}, once"),
        (10.0, track, "-"),
        (510.0, "WARN", f"injected from here: {what}, first frame 181h"),
        (510.0, track, "active"),
    ]


def test_kinds_and_links_have_windows_of_their_own_and_extended_frames_their_number() -> None:
    faults = InjectedFaults()
    strikes = [
        entry("loss", 10, DOWN),
        entry("loss", 20, UP),
        entry("delay", 30, DOWN),
        entry("loss", 15, DOWN, can_id=0x1F0 | 1 << 31),
        entry("corruption", 40, DOWN, can_id=0x1F0 | 1 << 31),
    ]
    found = told(*faults.take(strikes, ZERO))
    assert [at for at, _, text in found if text == "active"] == [10.0, 20.0, 30.0, 40.0]
    assert found[-2][2] == "injected from here: corruption host to drive, first frame 1F0h"
    ends = [text for _, level, text in told(*faults.finish()) if level == "INFO"]
    assert ends == [
        "injected until here: loss host to drive, 2 times within 5 ms",
        "injected until here: loss drive to host, once",
        "injected until here: delay host to drive, once",
        "injected until here: corruption host to drive, once",
    ]


def test_a_node_s_fault_ends_when_it_is_over() -> None:
    faults = InjectedFaults()
    found = told(*faults.take([entry("bus_off", 10, link=3, a=50 * NS_PER_MS)], ZERO))
    assert found == [
        (10.0, "WARN", "injected: bus off, node 3, it recovers after 50 ms"),
        (10.0, "injected bus off: node 3", "active"),
    ]
    assert faults.ended(Instant(ZERO + 60 * NS_PER_MS - 1)) == []
    assert told(*faults.ended(Instant(ZERO + 60 * NS_PER_MS))) == [(60.0, "injected bus off: node 3", "-")]
    assert faults.ended(Instant(1 << 60)) == [], "told once"


def test_one_that_does_not_end_is_open() -> None:
    faults = InjectedFaults()
    faults.take([entry("bus_off", 10, link=3, a=NONE)], ZERO)
    assert faults.ended(Instant(1 << 60)) == []


def test_memory_keeps_all_in_run_time(tmp_path: Path) -> None:
    plan = plan_for(tmp_path)
    kept, dropped = MemoryRecorder(plan, keep_all=True), MemoryRecorder(plan)
    records = list(synthetic_records(50, origin=ZERO))
    for recorder in (kept, dropped):
        first, second = recorder.tap(), recorder.tap(1)
        recorder.tell(TextEvent(Instant(ZERO + 5), "INFO", "x"))
        recorder.tell(BeginEvent(ZERO))
        second.frame("tx", 0x80, b"", False, False, Instant(ZERO + 2))
        first.frame("rx", 0x181, b"\1", True, True, Instant(ZERO + 1))
        for record in records:
            recorder.record(record)
        recorder.confirm(lambda: None)
        assert recorder.trouble() == ""
    summary = kept.close(whole_outcome(50))
    assert summary == dropped.close(whole_outcome(50))
    assert (summary.cycles, summary.seed) == (50, plan.seed)
    assert kept.rows().tobytes() == rows_of(records).tobytes()
    assert kept.table().column("due_at")[0].as_py() == 0
    assert kept.frames() == [
        KeptFrame("rx", 0x181, b"\1", True, True, Instant(1)),
        KeptFrame("tx", 0x80, b"", False, False, Instant(2)),
    ]
    events, zero = kept.told()
    assert zero == ZERO
    assert [event.at for event in events] == sorted(event.at for event in events)
    assert BeginEvent(ZERO) in events
    assert dropped.frames() == []
    assert dropped.rows().size == 0


FRAMES: Final = "(1.000000) can0 080#\n(1.000135) can0 181#2706\n(1.002000) can0 18105555#R\n"


def test_the_end_of_a_run_in_fault_is_written_line_by_line(tmp_path: Path) -> None:
    write_frames(tmp_path, FRAMES)
    said = [
        Emergency(7, 0x8210 + number, 0x11, bytes(5), Instant(number * NS_PER_MS)) for number in range(51)
    ]
    write_fault_report(tmp_path, "first\nsecond", said, {}, Instant(60 * NS_PER_MS))
    text = (tmp_path / "fault.txt").read_text().splitlines()
    assert text[:5] == [
        "What ended the run:",
        "  first",
        "  second",
        "",
        "EMCYs, the last ones of each code, in ms before the end:",
    ]
    assert text[5] == f"      59.000  node 7: {said[1].told(0, '')}"
    assert text[54] == f"      10.000  node 7: {said[50].told(0, '')}"
    assert text[55:] == [
        "",
        "The last 3 frames, in ms before the last:",
        "       2.000  080#                  SYNC",
        "       1.865  181#2706              TPDO1 of node 1",
        "       0.000  18105555#                  no identifier of CANopen",
    ]
    assert last_frames(tmp_path, 1) == [text[-1]]
