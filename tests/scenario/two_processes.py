"""One bench file with the drive in a process of its own, on whichever real-time bus."""

import json
import os
import signal
import subprocess
import sysconfig
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
HIL = str(Path(sysconfig.get_path("scripts"), "hil"))
BENCH = ROOT / "examples" / "any_bus.toml"
MOTOR = ROOT / "examples" / "motors" / "ling2012.toml"
CYCLES = 300
"""3 s at 100 Hz."""
RUN_TIMEOUT_S = 90
STOP_TIMEOUT_S = 20


@contextmanager
def simulated_drive(bus_spec: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """``hil simulate`` with node 1, on the bus when the block is entered, gone after it."""
    command = [HIL, "simulate", "--bus", bus_spec, "--node", "1", "--motor", str(MOTOR), *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=quiet_environment()) as process:
        try:
            assert process.stderr is not None
            announced = process.stderr.readline()
            assert announced, "hil simulate ended before its drive was on the bus"
            yield process
        finally:
            process.kill()


def impatient_bench(folder: Path) -> Path:
    """The same bench file, but for a drive that answers within a second."""
    patient = BENCH.read_text(encoding="utf-8")
    impatient = patient.replace("connect_timeout_s = 10.0", "connect_timeout_s = 1.0")
    assert impatient != patient
    (folder / "motors").symlink_to(MOTOR.parent)
    bench = folder / BENCH.name
    bench.write_text(impatient, encoding="utf-8")
    return bench


def run_bench(bus_spec: str, record: Path, bench: Path = BENCH) -> tuple[int, dict[str, Any], str]:
    """Exit status, summary and messages of ``hil run --json``."""
    command = [HIL, "run", str(bench), "--bus", bus_spec, "--record", str(record), "--json"]
    done = run(command)
    return done.returncode, json.loads(done.stdout or "{}"), done.stderr


def run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """The command to its end, its outputs as text."""
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        env=quiet_environment(),
        timeout=RUN_TIMEOUT_S,
        check=False,
    )


def quiet_environment() -> dict[str, str]:
    """The environment of the tests without analytics of the viewer."""
    return {**os.environ, "CI": "true"}


class TwoProcesses:
    """What holds with ``hil run`` and ``hil simulate`` on the bus of the fixture ``bus_spec``."""

    def test_the_bench_file_passes_and_is_recorded(self, bus_spec: str, tmp_path: Path) -> None:
        with simulated_drive(bus_spec) as drive:
            status, summary, messages = run_bench(bus_spec, tmp_path / "run")
            drive.send_signal(signal.SIGINT)
            drive_status = drive.wait(STOP_TIMEOUT_S)

        assert status == 0, messages
        assert drive_status == 0
        assert summary["verdict"]["passed"] is True
        assert summary["cycles"] > 0.9 * CYCLES
        assert summary["delay_us"]["p50"] > 0
        names = {path.name for path in (tmp_path / "run").iterdir()}
        assert {"run.rrd", "frames.log", "bench.toml", "summary.json"} <= names
        assert (tmp_path / "run" / "frames.log").stat().st_size > 0

    def test_a_run_leaves_the_drive_as_it_found_it(self, bus_spec: str, tmp_path: Path) -> None:
        """The load torque included: a second run of the same file starts from rest and passes too."""
        with simulated_drive(bus_spec):
            runs = [run_bench(bus_spec, tmp_path / name) for name in ("first", "second")]

        peaks = [summary["speed_error"]["peak_percent"] for _, summary, _ in runs]
        assert [status for status, _, _ in runs] == [0, 0], (peaks, [messages for _, _, messages in runs])

    def test_without_a_drive_the_run_ends_with_a_short_error(self, bus_spec: str, tmp_path: Path) -> None:
        status, summary, messages = run_bench(bus_spec, tmp_path / "run", impatient_bench(tmp_path))

        assert status == 3
        assert summary == {}
        assert "node 1" in messages
        assert "Traceback" not in messages
