"""No run is unrecorded without a word: full disks and dead loggers, in simulated time and on a hub."""

import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from servobench.drivers.errors import PeerFault
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.execution import bench as bench_module
from servobench.hil.execution.bench import run_bench
from servobench.hil.execution.drive_session import DriveSession
from servobench.hil.recording.append_file import FAULTS_TAIL_FILE, TAIL_FILE, read_tail
from servobench.hil.recording.logger_process import RecordingFailed
from servobench.hil.recording.recorder import Recorder, start_recording
from servobench.hil.rows.events import ENTRY_DTYPE
from servobench.hil.rows.faults_file import read_faults
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import ROW_DTYPE
from servobench.hil.verdict.summary import Summary
from tests.draws import few_of
from tests.scenario.processes import EXAMPLES, HIL, NO_DISK, RUN_TIMEOUT_S, on_disk_of, quiet_environment

LONG_S = 40
"""Some three times as long as it takes to fill the disk of the test."""
LING2012 = EXAMPLES / "ling2012.toml"


@pytest.fixture(scope="module")
def forked_children() -> None:
    """Loggers that are struck are real ones."""


def run_on_tiny_disk(size: str, tmp_path: Path, *options: str) -> tuple[int, str, Path]:
    """``hil run`` onto a tmpfs of ``size`` in a mount namespace of its own, for which nobody need be root.

    Exit status, what it said, and the folder of the run.
    """
    disk, kept = tmp_path / "disk", tmp_path / "kept"
    disk.mkdir()
    command = [*HIL, "run", str(options[0]), "--record", str(disk / "run"), *options[1:]]
    done = subprocess.run(
        on_disk_of(size, disk, kept, command),
        capture_output=True,
        text=True,
        env=quiet_environment(),
        timeout=RUN_TIMEOUT_S,
        check=False,
    )
    if done.returncode == NO_DISK:
        pytest.skip(f"no tmpfs in a namespace of its own here: {done.stderr}")
    return done.returncode, done.stdout + done.stderr, kept / "run"


@pytest.mark.parametrize("size", few_of(["4k", "200k"], 1))
def test_a_disk_that_is_full_before_the_start_moves_nothing(tmp_path: Path, size: str) -> None:
    status, said, _ = run_on_tiny_disk(size, tmp_path, str(LING2012))
    assert status == 5, said
    assert "hil: error: not recorded: " in said
    assert "No space left on device" in said
    assert "running" not in said
    assert "Traceback" not in said


@pytest.mark.parametrize("on_failure", ["stop", "continue"])
def test_a_disk_that_fills_up_leaves_a_verdict_and_whole_files(tmp_path: Path, on_failure: str) -> None:
    config = load_bench(LING2012)
    recording = config.recording.model_copy(update={"on_failure": on_failure})
    longer = config.bench.model_copy(update={"duration_s": LONG_S})
    bench = tmp_path / "bench.toml"
    bench.write_text(config.model_copy(update={"recording": recording, "bench": longer}).resolved_text())
    status, said, folder = run_on_tiny_disk("3m", tmp_path, str(bench))
    assert status == 5, said
    summary = summary_in(folder)
    verdict = summary["verdict"]
    assert "No space left on device" in verdict["reason"]
    assert not verdict["passed"]
    assert verdict["completed"] is (on_failure == "continue")
    assert (summary["cycles"] == 1000 * LONG_S) is (on_failure == "continue")
    assert verdict["outcome"] == "not recorded"
    with pa.OSFile(str(folder / "records.arrow")) as source:
        whole = pa.ipc.open_file(source).read_all().num_rows
    # what found no room in there lies in records.tail, and the summary says so
    assert 0 < whole + read_tail(folder / TAIL_FILE, ROW_DTYPE, whole).size <= summary["cycles"]
    assert (folder / "events.jsonl").read_bytes()[-1:] in (b"", b"\n")
    injected = len(read_faults(folder / "faults.arrow").entries)
    assert injected + read_tail(folder / FAULTS_TAIL_FILE, ENTRY_DTYPE, injected).size > 0
    assert (folder / "network.toml").stat().st_size > 0
    drive = drive_states(folder)
    assert drive[-1] == "switch on disabled"


def run_and_kill(
    tmp_path: Path,
    killed_in: str,
    on_failure: str = "stop",
    number: signal.Signals = signal.SIGKILL,
) -> Summary:
    """A run in simulated time whose logger is killed in a phase of it; in "running" after 0.3 s."""
    started: list[Recorder] = []

    def start(plan: RecordingPlan) -> Recorder:
        started.append(start_recording(plan))
        return started[0]

    def progress(phase: str, elapsed_s: float) -> None:
        if phase == killed_in and (phase != "running" or elapsed_s > 0.3) and len(started) == 1:
            os.kill(started[0].logger_process_id, number)
            os.waitid(os.P_PID, started[0].logger_process_id, os.WEXITED | os.WNOWAIT)
            started.append(started[0])

    config = load_bench(LING2012)
    recording = config.recording.model_copy(update={"on_failure": on_failure})
    return run_bench(
        config.model_copy(update={"recording": recording}),
        record=tmp_path / "run",
        progress=progress,
        privileged=False,
        recording=start,
    )


def summary_in(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return found


@pytest.mark.parametrize("phase", ["calibrating", "connecting", "configuring"])
def test_a_logger_killed_before_a_drive_is_enabled_lets_none_be_enabled(tmp_path: Path, phase: str) -> None:
    with pytest.raises(RecordingFailed, match="not recorded: the logger was killed by SIGKILL"):
        run_and_kill(tmp_path, phase)
    summary = summary_in(tmp_path / "run")
    assert summary["cycles"] == 0
    assert not summary["verdict"]["passed"]
    events = (tmp_path / "run" / "events.jsonl").read_text()
    assert "connecting" in events
    assert "operation enabled" not in events
    assert "stopping" in events


@pytest.mark.parametrize(
    ("error", "status"), [(PeerFault("the adapter is gone"), 3), (OSError("defect"), 70)]
)
def test_a_run_that_cannot_be_set_up_leaves_a_recording_that_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, status: int
) -> None:
    def refused(*_: object, **_options: object) -> DriveSession:
        raise error

    monkeypatch.setattr(bench_module, "DriveSession", refused)
    told: list[Summary] = []
    with pytest.raises(type(error)):
        run_bench(
            load_bench(LING2012),
            record=tmp_path / "run",
            concluded=told.append,
        )
    assert [summary.verdict.exit_status for summary in told] == [status]
    assert summary_in(tmp_path / "run")["verdict"]["exit_status"] == status
    assert not (tmp_path / "run" / ".reserve").exists()


def drive_states(folder: Path) -> list[str]:
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    return [event["state"] for event in events if event.get("track") == "axis1 drive"]


def test_a_logger_killed_in_mid_run_ends_the_run_at_once(tmp_path: Path) -> None:
    with pytest.raises(RecordingFailed) as caught:
        run_and_kill(tmp_path, "running")
    assert caught.value.exit_status == 5
    summary = summary_in(tmp_path / "run")
    assert 300 < summary["cycles"] <= 300 + 100 + 20
    assert summary["verdict"]["outcome"] == "not recorded"
    assert "the logger was killed by SIGKILL" in summary["verdict"]["reason"]
    assert drive_states(tmp_path / "run")[-1] == "switch on disabled"


@pytest.mark.parametrize("phase", ["enabling", "stopped", "stopping"])
def test_a_logger_killed_at_either_end_of_the_run_is_told(tmp_path: Path, phase: str) -> None:
    recorded = True
    try:
        recorded = not run_and_kill(tmp_path, phase).recording_faults
    except RecordingFailed:
        recorded = False
    assert not recorded
    summary = summary_in(tmp_path / "run")
    assert summary["cycles"] == (0 if phase == "enabling" else 2000)
    assert not summary["verdict"]["passed"]
    assert drive_states(tmp_path / "run")[-1] == "switch on disabled"


def test_a_run_that_is_to_go_on_unrecorded_loses_no_row_and_has_not_passed(tmp_path: Path) -> None:
    result = run_and_kill(tmp_path, "running", "continue")
    assert result.recording_faults
    assert not result.verdict.passed
    summary = summary_in(tmp_path / "run")
    assert summary["cycles"] == 2000
    assert summary["verdict"]["completed"]
    with pa.OSFile(str(tmp_path / "run" / "records.arrow")) as source:
        numbers = pa.ipc.open_file(source).read_all()["sequence"].to_pylist()
    assert numbers == list(range(1, 2001))
    assert not any("lost" in fault for fault in summary["recording_faults"])
