"""What is recorded of a run on a hub when one of its processes is killed, or its logger is held up."""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, wall_clock_offset
from servobench.hil.pytest_plugin import StartDrive
from servobench.hil.rows.records_file import read_metadata, read_records
from servobench.hil.rows.run_files import FIRST_CYCLE
from tests.draws import few_of
from tests.recorded_frames import candump_text
from tests.scenario.processes import (
    HIL,
    broker_of,
    changed_bench,
    logger_of,
    long_bench,
    loop_of,
    observer,
    start_run,
    summary_of,
)
from tests.scenario.test_exit_paths import MARGIN_S, QUICK_STOP_S, TURNING_RAD_S
from tests.warm.start import hil

pytestmark = [pytest.mark.servo_bus("hub"), pytest.mark.xdist_group("real time")]

LOST_MAX_NS = 200 * NS_PER_MS
LOOK_MAX_S = 0.1
"""The loop looks at its logger every 50 ms, and notices in the cycle after."""
RESIDENT_MAX_KB = 300_000


def lost_before(folder: Path, at: Instant) -> int:
    """From the last cycle that is recorded without a gap until ``at`` of the monotonic clock, ns."""
    records = folder / "records.arrow"
    rows = np.concatenate(list(read_records(records, int(read_metadata(records)[FIRST_CYCLE]))))
    assert rows["sequence"].tolist() == list(range(1, rows.size + 1))
    frames = candump_text(folder)
    assert frames.endswith("\n")
    last_frame_ns = round(float(frames.splitlines()[-1].split(")")[0][1:]) * NS_PER_S)
    assert at + wall_clock_offset() - last_frame_ns <= LOST_MAX_NS, "frames are missing"
    return int(at - rows["due_at"][-1])


@pytest.mark.parametrize("victim", few_of(["logger", "host", "broker", "drive"], 2))
def test_what_a_killed_process_costs(
    servo_bus: str, servo_process: StartDrive, tmp_path: Path, victim: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    drive = servo_process(1)
    with observer(servo_bus) as watching:
        # a cycle is recorded when its fate is known: after so many periods at the latest
        bench = changed_bench(tmp_path, duration_s=60.0, horizon_periods=5)
        own = victim in ("host", "logger")
        process = start_run(bench, servo_bus, folder, by=HIL if own else hil())
        watching.until_turning(TURNING_RAD_S)
        at = watching.now()
        if victim == "host":
            process.kill()
        elif victim == "logger":
            os.kill(logger_of(process.pid), signal.SIGKILL)
            assert watching.time_to_rest(at, LOOK_MAX_S + QUICK_STOP_S + MARGIN_S)
            watching.until(State.SWITCH_ON_DISABLED, MARGIN_S)
        elif victim == "broker":
            os.kill(broker_of(servo_bus), signal.SIGKILL)
            assert drive.wait(20.0) == 3
        else:
            drive.kill()
        _, said = process.communicate(timeout=60)
    assert process.returncode == {"host": -signal.SIGKILL, "logger": 5}.get(victim, 3), said
    summary = summary_of(folder)
    assert not summary["verdict"]["passed"]
    lost_ns = lost_before(folder, at)
    assert lost_ns <= LOST_MAX_NS
    with capsys.disabled():
        print(f"\n{victim} killed: exit {process.returncode}, {max(0, lost_ns) / NS_PER_MS:.0f} ms lost")
    if victim == "logger":
        assert "hil: error: not recorded: the logger was killed by SIGKILL" in said
        assert summary["verdict"]["outcome"] == "not recorded"


def test_a_logger_that_is_held_up_and_catches_up_costs_nothing(
    servo_bus: str, servo_process: StartDrive, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    servo_process(1)
    with observer(servo_bus) as watching:
        process = start_run(changed_bench(tmp_path, duration_s=4.0), servo_bus, folder)
        watching.until_turning(TURNING_RAD_S)
        logger = logger_of(process.pid)
        os.kill(logger, signal.SIGSTOP)
        watching.wait(1.5)
        os.kill(logger, signal.SIGCONT)
        out, said = process.communicate(timeout=60)
    assert process.returncode in (0, 1, 6), said
    assert "recording_faults" not in json.loads(out)
    rows = np.concatenate(list(read_records(folder / "records.arrow")))
    assert rows["sequence"].tolist() == list(range(1, 401))


def test_the_loop_and_its_logger_stay_small(
    servo_bus: str, servo_process: StartDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    servo_process(1)
    with observer(servo_bus) as watching:
        process = start_run(long_bench(tmp_path), servo_bus, tmp_path / "run")
        watching.until_turning(TURNING_RAD_S)
        resident = [resident_kb(loop_of(process.pid)), resident_kb(logger_of(process.pid))]
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    with capsys.disabled():
        print(f"\nresident, at most: loop {resident[0] / 1000:.0f} MB, logger {resident[1] / 1000:.0f} MB")
    assert max(resident) < RESIDENT_MAX_KB


def resident_kb(process_id: int) -> int:
    """The most that a process has had in memory, kB."""
    lines = Path(f"/proc/{process_id}/status").read_text().splitlines()
    (peak,) = (int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
    return peak
