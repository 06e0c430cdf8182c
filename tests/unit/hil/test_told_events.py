"""Events that nobody says: they follow from the rows, and from the entries of the fault log."""

from collections.abc import Sequence

import numpy as np

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.loop.cycle_record import NOTHING
from servobench.hil.rows.events import WINDOW_GAP, InjectedFaults
from servobench.hil.rows.recording_plan import PlannedSetPoint, SetPointTeller
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.side_rows import StateEvent, TextEvent
from servobench.virtual_bus.faults.fault_log import KIND_CODES, FaultEntry
from servobench.virtual_bus.faults.fault_table import NONE

ZERO = Instant(7 * NS_PER_S)
PLANNED = (
    PlannedSetPoint(Duration(0), 0, "a"),
    PlannedSetPoint(Duration(3 * NS_PER_MS), 1, "b"),
    PlannedSetPoint(Duration(3 * NS_PER_MS), 0, "c"),
    PlannedSetPoint(Duration(9 * NS_PER_MS), 0, "d"),
)


def rows_of(cycles: range, axis: int, unsent: Sequence[int] = ()) -> Rows:
    rows = np.zeros(len(cycles), ROW_DTYPE)
    rows["axis"] = axis
    rows["due_at"] = ZERO + np.array(cycles) * NS_PER_MS
    rows["command_handed_at"] = rows["due_at"] + 400
    for cycle in unsent:
        rows["command_handed_at"][cycle - cycles.start] = NOTHING
    return rows


def told(events: Sequence[TextEvent | StateEvent]) -> list[tuple[int, str]]:
    return [(event.at - ZERO, event.text) for event in events if isinstance(event, TextEvent)]


def lanes(events: Sequence[TextEvent | StateEvent]) -> list[tuple[int, str, str]]:
    return [(event.at - ZERO, event.track, event.label) for event in events if isinstance(event, StateEvent)]


def test_a_set_point_is_told_once_by_the_command_that_acted_upon_it() -> None:
    teller = SetPointTeller(PLANNED)
    assert told(teller.take(rows_of(range(3), 0), ZERO)) == [(400, "a")]
    assert told(teller.take(rows_of(range(3, 6), 0), ZERO)) == [(3 * NS_PER_MS + 400, "c")]
    assert told(teller.take(rows_of(range(6, 9), 0), ZERO)) == []


def test_of_another_axis_only_by_its_own_rows() -> None:
    teller = SetPointTeller(PLANNED)
    both = np.concatenate([rows_of(range(5), 0), rows_of(range(5), 1)])
    assert [text for _, text in told(teller.take(both, ZERO))] == ["a", "c", "b"]


def test_of_one_instant_by_axis_wherever_the_rows_are_taken_in_two_parts() -> None:
    both = np.concatenate([rows_of(range(5), 0), rows_of(range(5), 1)])
    rows = both[np.lexsort((both["axis"], both["due_at"]))]
    for split in range(rows.size + 1):
        teller = SetPointTeller(PLANNED)
        taken = teller.take(rows[:split], ZERO) + teller.take(rows[split:], ZERO)
        assert [text for _, text in told(taken)] == ["a", "c", "b"]


def test_a_cycle_that_sent_nothing_acted_upon_nothing() -> None:
    teller = SetPointTeller(PLANNED)
    assert told(teller.take(rows_of(range(5), 0, unsent=[3]), ZERO))[1:] == [(4 * NS_PER_MS + 400, "c")]


def test_what_the_run_did_not_come_to_is_never_told() -> None:
    teller = SetPointTeller(PLANNED)
    assert "d" not in [text for _, text in told(teller.take(rows_of(range(9), 0), ZERO))]


def entry(kind: str, at_ms: float, a: int = 0, link: int = 1, c: int = 0) -> FaultEntry:
    return FaultEntry(round(at_ms * NS_PER_MS), a, 0, c, 0x181, 0, KIND_CODES[kind], link)


def test_what_befalls_a_node_is_told_at_its_instant() -> None:
    found = InjectedFaults().take(
        [
            entry("silence", 600, 30 * NS_PER_MS),
            entry("bus_off", 800, NONE),
            entry("bus_off", 900, 500 * NS_PER_MS),
            entry("clock_step", 950, -40_000),
            entry("drive_fault", 1500, 1),
            entry("boot", -300, 200 * NS_PER_MS),
        ],
        ZERO,
    )
    assert told(found) == [
        (-300 * NS_PER_MS, "injected: boot of 200 ms, node 1"),
        (600 * NS_PER_MS, "injected: silence of 30 ms, node 1"),
        (800 * NS_PER_MS, "injected: bus off, node 1"),
        (900 * NS_PER_MS, "injected: bus off, node 1, it recovers after 500 ms"),
        (950 * NS_PER_MS, "injected: clock step of -40 us, node 1"),
        (1500 * NS_PER_MS, "injected: drive fault over temperature, node 1"),
    ]


def test_strikes_at_frames_are_told_as_windows() -> None:
    faults, gap_ms = InjectedFaults(), WINDOW_GAP / NS_PER_MS
    first = faults.take([entry("loss", 100, link=0), entry("loss", 100 + gap_ms, link=0)], ZERO)
    assert told(first) == [
        (100 * NS_PER_MS, "injected from here: loss host to drive, first frame 181h"),
    ]
    again_ms = 100 + 2 * gap_ms + 1
    second = faults.take([entry("loss", again_ms, link=0), entry("delay", again_ms, link=1)], ZERO)
    assert told(second) == [
        (
            round((100 + gap_ms) * NS_PER_MS),
            f"injected until here: loss host to drive, 2 times within {gap_ms:g} ms",
        ),
        (again_ms * NS_PER_MS, "injected from here: loss host to drive, first frame 181h"),
        (again_ms * NS_PER_MS, "injected from here: delay drive to host, first frame 181h"),
    ]
    assert [text for _, text in told(faults.finish())] == [
        "injected until here: loss host to drive, once",
        "injected until here: delay drive to host, once",
    ]
    assert faults.finish() == []


def test_stalls_of_the_host_are_windows_too() -> None:
    begun, _ = InjectedFaults().take([entry("host_stall", 1, 5 * NS_PER_MS, link=0)], ZERO)
    assert isinstance(begun, TextEvent)
    assert begun.text == "injected from here: host stall, first by 5 ms"


def test_a_lane_of_a_fault_is_active_from_the_first_to_the_last_strike() -> None:
    faults = InjectedFaults()
    found = faults.take([entry("loss", at, link=0) for at in (10, 200, 400)], ZERO)
    found += faults.take([entry("silence", 450, 30 * NS_PER_MS)], ZERO)
    found += faults.finish()
    track = next(track for _, track, _ in lanes(found))
    assert track.startswith("injected loss: ")
    assert [(at, label) for at, name, label in lanes(found) if name == track] == [
        (10 * NS_PER_MS, "active"),
        (400 * NS_PER_MS, "-"),
    ]
    assert (450 * NS_PER_MS, "injected silence: node 1", "active") in lanes(found)


def test_a_lane_of_a_fault_of_a_node_is_active_for_as_long_as_it_lasts() -> None:
    faults = InjectedFaults()
    found = faults.take(
        [
            entry("clock_drift", 400, 80_000),
            entry("silence", 600, 30 * NS_PER_MS),
            entry("clock_drift", 1400, -80_000),
            entry("safe_torque_off", 1450, 200 * NS_PER_MS),
        ],
        ZERO,
    )
    found += [
        *faults.ended(Instant(ZERO + 1600 * NS_PER_MS)),
        *faults.ended(Instant(ZERO + 1600 * NS_PER_MS)),
    ]
    by_track: dict[str, list[tuple[int, str]]] = {}
    for at, track, label in lanes(found):
        by_track.setdefault(track, []).append((at // NS_PER_MS, label))
    assert by_track == {
        "injected clock drift: node 1": [(400, "active"), (1400, "-")],
        "injected silence: node 1": [(600, "active"), (630, "-")],
        "injected safe torque off: node 1": [(1450, "active")],  # over after the end, which nobody knows of
    }
