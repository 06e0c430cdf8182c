"""A recording says what happened, when it happened, by the frame or the act: never what was only planned."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.execution.bench import run_bench
from servobench.hil.loop.pace import CALIBRATION_SYNCS
from servobench.hil.recording.run_recorder import MemoryRecorder
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.run_files import EVENTS_FILE
from servobench.hil.rows.side_rows import StateEvent, TextEvent
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.run import Run
from tests.recorded_frames import candump_text, injected
from tests.scenario.processes import EXAMPLES

LING2012 = EXAMPLES / "ling2012.toml"
BUS_OFF = {"bus_off": [{"nodes": [1], "at_s": 0.8}]}


def texts(run: Run, part: str) -> list[tuple[float, str]]:
    """(s, text) of the events whose text has ``part`` in it."""
    return [
        (event["at_ns"] / NS_PER_S, event["text"]) for event in run.events if part in event.get("text", "")
    ]


def states(run: Run, track: str) -> list[tuple[int, str]]:
    return [(event["at_ns"], event["state"]) for event in run.events if event.get("track") == track]


def signed(data: bytes) -> int:
    return int.from_bytes(data, "little", signed=True)


def ended(bench: BenchRunner, faults: Path | dict[str, Any]) -> Run:
    run = bench(LING2012, faults=faults, ends_in=BenchError)
    assert run.error is not None
    return run


def last_of(run: Run, level: str) -> dict[str, Any]:
    (found,) = [event for event in run.events if event.get("level") == level]
    return found


def test_a_run_that_was_dead_lists_no_load_and_nothing_after_its_last_frame(servo_bench: BenchRunner) -> None:
    run = ended(servo_bench, BUS_OFF)
    assert [at_s for at_s, _ in texts(run, "reference step")] == pytest.approx([0.2], abs=0.001)
    assert texts(run, "load torque") == []
    assert max(event["at_ns"] for event in run.events) <= run.wire.frames[-1].at
    assert [at_s for at_s, _ in texts(run, "injected: bus off, node 1")] == [0.8]


def test_what_a_run_comes_to_is_told_when_it_does(servo_bench: BenchRunner) -> None:
    run = servo_bench(LING2012, faults={})
    assert [at_s for at_s, _ in texts(run, "reference step")] == pytest.approx([0.2], abs=0.001)
    assert [at_s for at_s, _ in texts(run, "load torque")] == pytest.approx([1.0], abs=0.001)
    assert [event["at_ns"] for event in run.events] == sorted(event["at_ns"] for event in run.events)
    lines = [json.loads(line) for line in (run.folder / EVENTS_FILE).read_text(encoding="utf-8").splitlines()]
    assert sorted(lines, key=str) == sorted(run.events, key=str)
    set_points = ("reference step", "load torque")  # known with the row of their cycle
    at_once = [
        line["at_ns"] for line in lines if not any(part in line.get("text", "") for part in set_points)
    ]
    assert at_once == sorted(at_once)


@pytest.mark.parametrize("example", ["ling2012.toml", "three_axes.toml"])
def test_what_the_drives_come_to_is_told_in_order_of_time(example: str) -> None:
    """As it comes to be known, whatever of it is written together."""
    recorders: list[MemoryRecorder] = []

    def in_memory(plan: RecordingPlan) -> MemoryRecorder:
        recorders.append(MemoryRecorder(plan))
        return recorders[-1]

    config = Bench.load(EXAMPLES / example).config
    run_bench(config, bus_spec="simulated", privileged=False, recording=in_memory)
    told = [event.at for event in recorders[0].events if isinstance(event, TextEvent | StateEvent)]
    assert len(told) > 10
    assert told == sorted(told)


@pytest.mark.parametrize("fault", ["over_temperature", "over_current", "under_voltage"])
def test_a_fault_of_a_drive_has_the_time_of_its_emcy(servo_bench: BenchRunner, fault: str) -> None:
    run = ended(servo_bench, {"drive_fault": [{"fault": fault, "nodes": [1], "at_s": 1.5}]})
    emcy = run.wire.find("081#*", sent=False)[0]
    assert emcy.at == pytest.approx(1.5 * NS_PER_S, abs=NS_PER_MS)
    assert abs(last_of(run, "CRITICAL")["at_ns"] - emcy.at) < NS_PER_MS
    faulty = [at for at, state in states(run, "axis1 drive") if state.startswith("fault")]
    assert abs(faulty[0] - emcy.at) < NS_PER_MS
    told = [text for _, text in texts(run, "injected")]
    assert told == [f"injected: drive fault {fault.replace('_', ' ')}, node 1"]


def test_the_calibration_is_there_sync_by_sync_with_its_reading(servo_bench: BenchRunner) -> None:
    run = servo_bench(LING2012, {"bench.duration_s": 0.3, "load": {}}, faults={})
    phases = {state: at for at, state in states(run, "phase")}
    there = [
        frame.can_id
        for frame in run.wire.frames
        if phases["calibrating"] <= frame.at < phases["enabling"] and frame.can_id in (0x080, 0x181)
    ]
    assert there == [0x080, 0x181] * CALIBRATION_SYNCS
    assert set(np.diff(run.rows["sequence"], prepend=0)) == {1}, "a row is a planned cycle, and nothing else"


def test_the_stopping_is_there_until_the_drive_rests(servo_bench: BenchRunner) -> None:
    run = ended(servo_bench, {"drive_fault": [{"fault": "over_temperature", "nodes": [1], "at_s": 1.5}]})
    stopping = next(at for at, state in states(run, "phase") if state == "stopping")
    ((rest_s, _),) = texts(run, "at rest")
    assert rest_s * NS_PER_S > stopping > last_of(run, "CRITICAL")["at_ns"]
    asked = run.wire.between(stopping / NS_PER_S, rest_s + 1e-6).find("581#436C6000*", sent=False)
    told = run.wire.between(1.4, 1.401).find("181#*")
    assert asked, "the speed 606Ch was asked for"
    assert 100 * abs(signed(asked[-1].data[4:8])) < abs(signed(told[0].data[:4])), "and is that of a rest"


def test_a_limit_that_was_crossed_is_told_before_the_stopping(servo_bench: BenchRunner) -> None:
    run = ended(servo_bench, BUS_OFF)
    assert 0.9 <= last_of(run, "CRITICAL")["at_ns"] / NS_PER_S < 0.91


def test_faults_of_frames_have_their_first_and_last_frame(servo_bench: BenchRunner) -> None:
    blackout = {"blackout": [{"from_s": 0.5, "duration_s": 0.01, "count": 1, "frames": ["all"]}]}
    run = servo_bench(LING2012, faults=blackout)
    lines = injected(run.folder)
    for way in ("host_to_drive", "drive_to_host"):
        struck = [entry["at_ns"] for entry in lines if entry["direction"] == way]
        found = texts(run, f"blackout {way.replace('_', ' ')}")
        assert [round(at_s * NS_PER_S) for at_s, _ in found] == [struck[0], struck[-1]]
        assert 0.5 <= found[0][0] <= found[1][0] < 0.51


def test_every_file_counts_from_the_first_cycle(servo_bench: BenchRunner) -> None:
    run = servo_bench(LING2012, faults={"loss": [{"probability": 0.05}]})
    syncs = [frame.at for frame in run.wire.find("080#", sent=True)]
    assert int(run.rows["due_at"][0]) == 0
    assert abs(min(syncs, key=abs)) < NS_PER_MS
    assert [event["at_ns"] for event in run.events if event.get("begin")] == [0]
    lost = injected(run.folder)
    readings = [entry for entry in lost if entry["can_id"] == 0x181]
    dropped = run.rows[run.rows["fate"] == 1]["due_at"]
    assert readings, "some were lost"
    for entry in readings[:20]:
        assert min(abs(dropped - entry["at_ns"])) < NS_PER_MS
    assert candump_text(run.folder).startswith("(0999999999."), "before the first cycle"
