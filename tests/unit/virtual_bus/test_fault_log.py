"""The log of what was injected: its lines, and their replay."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import EXTENDED_FLAG
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.fates import FateSource, RecordedFaults, ReplayedFates, read_recorded
from servobench.virtual_bus.faults.fault_injector import FaultInjector
from servobench.virtual_bus.faults.fault_log import (
    BLOCK_BYTES,
    KIND_CODES,
    KINDS,
    FaultEntry,
    FaultLog,
    entries_of,
    entry_line,
    read_line,
)
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.fault_table import NONE
from servobench.virtual_bus.faults.frame_fault import FrameFault
from servobench.virtual_bus.faults.kinds.blackout import Blackout
from servobench.virtual_bus.faults.kinds.periodic_loss import PeriodicLoss
from servobench.virtual_bus.faults.kinds.slow_drive import SlowDrive
from servobench.virtual_bus.faults.node_faults import DrawnNode, ReplayedNode
from servobench.virtual_bus.frame import Frame
from tests.draws import examples_of
from tests.fates import fate_of, keys
from tests.unit.virtual_bus.test_faults import IN, MS, OUT, RPDO1, TPDO1, TPDO2, uniform
from tests.unit.virtual_bus.test_special_faults import ONE_OF_EACH

Outcome = tuple[bool, int, list[tuple[Frame, Duration]]]
ENTRIES = [
    ('{"kind":"loss","at_ns":5,"direction":"drive_to_host","can_id":385,"n":2}', "loss"),
    (
        '{"kind":"delay","at_ns":5,"direction":"host_to_drive","can_id":74565,"extended":true,'
        '"n":2,"delay_ns":7,"in_order":false}',
        "delay",
    ),
    (
        '{"kind":"delay","at_ns":5,"direction":"drive_to_host","can_id":385,"n":2,"delay_ns":7}',
        "delay",
    ),
    (
        '{"kind":"corruption","at_ns":5,"direction":"drive_to_host","can_id":385,"n":2,'
        '"bit":99,"delay_ns":4}',
        "corruption",
    ),
    ('{"kind":"corruption","at_ns":5,"direction":"drive_to_host","can_id":385,"n":2}', "corruption"),
    ('{"kind":"bus_off","at_ns":5,"node":3}', "bus_off"),
    ('{"kind":"bus_off","at_ns":5,"node":3,"recover_after_ns":9}', "bus_off"),
    (
        '{"kind":"drive_fault","at_ns":5,"node":3,"fault":"encoder_loss","detected_after_ns":1,'
        '"duration_ns":2}',
        "drive_fault",
    ),
    ('{"kind":"clock_step","at_ns":5,"node":3,"step_ns":-9}', "clock_step"),
    ('{"kind":"boot","at_ns":5,"node":3,"n":0,"delay_ns":3}', "boot"),
    ('{"kind":"late","at_ns":5,"node":3,"can_id":1409,"n":0,"delay_ns":3}', "late"),
    (
        '{"kind":"delay","at_ns":5,"direction":"drive_to_host","side":"drive","node":127,"can_id":385,'
        '"n":2,"delay_ns":7}',
        "delay",
    ),
    (
        '{"kind":"loss","at_ns":5,"direction":"host_to_drive","side":"drive","node":1,"can_id":128,"n":2}',
        "loss",
    ),
    ('{"kind":"host_stall","at_ns":5,"n":12,"late_ns":3400000}', "host_stall"),
]


@pytest.mark.parametrize(("line", "kind"), ENTRIES)
def test_a_line_is_read_and_written_the_same(line: str, kind: str) -> None:
    entry = read_line(line, "f", 1)
    assert entry.kind == kind
    assert entry_line(entry) == line


def test_the_numbers_of_an_entry_stand_where_the_log_says() -> None:
    assert read_line(ENTRIES[1][0], "f", 1) == FaultEntry(
        5, 7, 0, 0, 74565 | EXTENDED_FLAG, 2, KIND_CODES["delay"], 0
    )
    assert read_line(ENTRIES[5][0], "f", 1).a == NONE


@pytest.mark.parametrize(
    ("line", "key", "expected"),
    [
        ("{", "line 7", "a line of a recorded run's faults"),
        ("[]", "line 7", "whose kind is one of loss"),
        ('{"kind": "lost"}', "line 7", "whose kind is one of loss"),
        ('{"kind": "loss", "can_id": 1, "n": 0, "at_ns": 0}', "line 7: direction", "one of host_to_drive"),
        (
            '{"kind": "loss", "direction": "drive_to_host", "can_id": 2048, "n": 0, "at_ns": 0}',
            "line 7: can_id",
            "a whole number from 0 to 2047",
        ),
        ('{"kind": "silence", "node": 0}', "line 7: node", "a whole number from 1 to 127"),
        (
            '{"kind": "loss", "direction": "drive_to_host", "side": "drive", "can_id": 1, "n": 0}',
            "line 7: node",
            "a whole number from 1 to 127",
        ),
        (
            '{"kind": "loss", "direction": "drive_to_host", "side": "bus", "can_id": 1, "n": 0}',
            "line 7: side",
            "drive, or no side",
        ),
        ('{"kind": "host_stall", "n": 1, "at_ns": 0}', "line 7: late_ns", "a whole number from 0"),
        (
            '{"kind": "drive_fault", "node": 1, "at_ns": 0, "fault": "x"}',
            "line 7: fault",
            "one of over_current, over_temperature",
        ),
        (
            '{"kind": "silence", "node": 1, "at_ns": 0, "duration_ns": true}',
            "line 7: duration_ns",
            "whole number",
        ),
    ],
)
def test_a_line_that_cannot_be_used_is_refused_with_its_place(line: str, key: str, expected: str) -> None:
    with pytest.raises(BadInput) as caught:
        read_line(line, "faults.jsonl", 7)
    assert caught.value.source == "faults.jsonl"
    assert caught.value.key == key
    assert expected in caught.value.expected


def test_blocks_reach_the_sink_in_order_also_those_from_before_it_was_there() -> None:
    log, found = FaultLog(), list[bytes]()
    for n in range(100):
        log.note(0, n, 1, 0x181, n)
    log.send_to(lambda length, block: found.append(block[:length]))
    for n in range(100, 205):
        log.note(0, n, 1, 0x181, n)
    log.flush()
    log.flush()
    assert all(len(block) <= BLOCK_BYTES for block in found)
    assert [entry.n for block in found for entry in entries_of(block)] == list(range(205))
    assert log.entries() == []


def test_kinds_fit_into_the_byte_of_an_entry() -> None:
    assert len(set(KINDS)) == len(KINDS) < 256


def outcomes(source: FateSource, traffic: list[tuple[Direction, int, int]]) -> list[Outcome]:
    """What becomes of each frame: lost or not, delay, and what goes on instead."""
    found: list[Outcome] = []
    source.start(Instant(0))
    for direction, can_id, at in traffic:
        fate = fate_of(source, direction, can_id, Instant(at))
        instead = list(source.replacements(Frame(can_id, bytes(4)))) if fate.dropped else []
        found.append((fate.dropped, fate.delay_ns, instead))
    return found


def recorded(log: FaultLog) -> RecordedFaults:
    """As if it had been written to a file and read again."""
    return RecordedFaults(tuple(read_line(entry_line(entry), "f", 1) for entry in log.entries()))


def counted(source: FateSource) -> dict[str, dict[str, int]]:
    """What it has counted, without what never struck."""
    return {way: {what: n for what, n in found.items() if n} for way, found in source.counts().items()}


KEYS = ((OUT, RPDO1), (IN, TPDO1), (IN, TPDO2), (IN, 0x182), (IN, 0x581), (OUT, 0x080))


@examples_of(60)
@given(
    chosen=st.sets(st.integers(0, len(ONE_OF_EACH) + 2), max_size=6),
    picks=st.lists(st.tuples(st.integers(0, 5), st.integers(0, 4000)), min_size=1, max_size=150),
    seed=st.integers(0, 99),
)
def test_a_replay_gives_every_frame_the_fate_that_it_had(
    chosen: set[int], picks: list[tuple[int, int]], seed: int
) -> None:
    window = keys(from_s=1e-9 * 50_000, until_s=1e-9 * 90_000)
    every: tuple[FrameFault, ...] = (
        *ONE_OF_EACH,
        PeriodicLoss(lost=2),
        Blackout(**window),
        uniform(0, 3000),
    )
    plan = FaultPlan(tuple(every[index] for index in sorted(chosen)))
    at, traffic = 0, list[tuple[Direction, int, int]]()
    for pick, gap in picks:
        at += gap
        traffic.append((*KEYS[pick], at))
    log, again = FaultLog(), FaultLog()
    original = FaultInjector(plan, seed, log=log)
    first = outcomes(original, traffic)
    faults = recorded(log)
    replayed = ReplayedFates(faults, again)
    assert outcomes(replayed, traffic) == first
    assert recorded(again) == faults
    assert counted(replayed) == counted(original)


def test_a_replay_strikes_the_same_frames_of_other_traffic() -> None:
    """Another node's frames in between, and other instants: the n-th frame meets what the n-th met."""
    plan = FaultPlan((PeriodicLoss(lost=1), uniform(10, 500)))
    log = FaultLog()
    first = outcomes(FaultInjector(plan, 1, log=log), [(IN, TPDO1, k * MS) for k in range(50)])
    traffic = [(IN, can_id, k * MS + 7) for k in range(50) for can_id in (0x182, TPDO1)]
    again = outcomes(ReplayedFates(recorded(log)), traffic)
    assert again[1::2] == first
    assert {outcome[:2] for outcome in again[::2]} == {(False, 0)}


def test_a_replay_keeps_frames_in_order_that_were_so() -> None:
    log = FaultLog()
    traffic = [(IN, TPDO1, k * 100) for k in range(200)]
    outcomes(FaultInjector(FaultPlan((uniform(0, 900),)), 1, log=log), traffic)
    closer = [(IN, TPDO1, k * 10) for k in range(200)]
    releases = [
        at + found[1]
        for (_, _, at), found in zip(closer, outcomes(ReplayedFates(recorded(log)), closer), strict=True)
    ]
    assert releases == sorted(releases)


def test_frames_before_time_zero_and_after_the_end_count_for_nothing() -> None:
    log = FaultLog()
    source = FaultInjector(FaultPlan((PeriodicLoss(lost=1),)), 1, log=log)
    fate_of(source, IN, TPDO1, Instant(0))
    source.start(Instant(100))
    for k in range(4):
        fate_of(source, IN, TPDO1, Instant(100 + k))
    source.stop()
    fate_of(source, IN, TPDO1, Instant(900))
    assert [(entry.n, entry.at_ns) for entry in log.entries()] == [(1, 1), (3, 3)]


def test_a_recorded_node_is_late_as_it_was() -> None:
    slow = SlowDrive(
        sdo_delay_min_us=5 / 1000,
        sdo_delay_max_us=900 / 1000,
        boot_min_s=7 / 1e9,
        boot_max_s=70 / 1e9,
    )
    source = DrawnNode(FaultPlan(node_faults=(slow,)), 4, 1)
    boot, late = source.boot_time(), [source.lateness(0x584) for _ in range(20)]
    log = FaultLog()
    log.note(KIND_CODES["boot"], 0, 4, 0, 0, boot)
    for n, held in enumerate(late):
        log.note(KIND_CODES["late"], n, 4, 0x584, n, held)
    again = ReplayedNode(recorded(log), 4)
    assert (again.boot_time(), [again.lateness(0x584) for _ in range(20)]) == (boot, late)
    assert (again.boot_time(), again.lateness(0x584)) == (0, 0)
    assert ReplayedNode(recorded(log), 5).idle


def test_a_file_is_read_line_by_line(tmp_path: Path) -> None:
    path = tmp_path / "faults.jsonl"
    path.write_text("\n".join(line for line, _ in ENTRIES) + "\n\n")
    faults = read_recorded(path)
    assert [json.loads(entry_line(entry)) for entry in faults.entries] == [
        json.loads(line) for line, _ in ENTRIES
    ]
    assert faults.node_kinds == ("bus_off", "drive_fault", "clock_step", "late", "boot", "host_stall")
    assert faults.drives_struck == {1, 127}
    with pytest.raises(BadInput, match="not found"):
        read_recorded(tmp_path / "none.jsonl")
