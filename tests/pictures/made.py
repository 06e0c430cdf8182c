"""Recordings of every kind to be drawn, in simulated time and from a seed."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import rerun as rr
from typer.testing import CliRunner

from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from servobench.hil.cli import app
from servobench.hil.configuration.bench_file import Bench, bench_from
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.execution.bench import run_bench
from servobench.hil.machine.progress import Progress, no_progress
from servobench.hil.machine.stopping import StopRequest
from servobench.hil.recording.telemetry import Telemetry
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.records_file import read_records
from servobench.hil.rows.run_files import EVENTS_FILE, RECORDS_FILE, RERUN_FILE, SUMMARY_FILE
from servobench.hil.rows.side_rows import BeginEvent, StateEvent, TextEvent
from servobench.hil.verdict.verdict import VerdictKind
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.synthetic_run import PERIOD

EXAMPLES: Final = Path(__file__).parents[2] / "examples"
_ENDED_AT_S: Final = 1.2
_LOGGER_MAX_NS: Final = 30 * NS_PER_S

Make = Callable[[Path], Path]
"""Into a new folder; what ``hil picture`` is given then."""


def run(bench: str, changes: Mapping[str, Any], ends: VerdictKind = VerdictKind.PASSED) -> Make:
    """``bench``: name of an example. Error: AssertionError if it comes to another outcome than ``ends``."""

    def make(folder: Path) -> Path:
        assert _outcome(bench, changes, folder, no_progress, StopRequest()) is ends
        return folder

    return make


def _outcome(
    bench: str, changes: Mapping[str, Any], folder: Path, progress: Progress, stop: StopRequest
) -> VerdictKind:
    made = Bench.load(EXAMPLES / bench).changed(changes)
    concluded: list[VerdictKind] = []
    try:
        run_bench(
            bench_from(made.tables, made.source, made.folder),
            record=folder,
            progress=progress,
            privileged=False,
            stop=stop,
            concluded=lambda summary: concluded.append(summary.verdict.outcome),
        )
    except BenchError:
        if not concluded:
            raise
    return concluded[-1]


def interrupted(folder: Path) -> Path:
    """By Ctrl-C, in the middle."""
    stop = StopRequest()

    def ask(phase: str, elapsed_s: float) -> None:  # noqa: ARG001
        if elapsed_s >= _ENDED_AT_S:
            stop.ask("SIGINT")

    assert _outcome("ling2012.toml", {}, folder, ask, stop) is VerdictKind.INTERRUPTED
    return folder


def killed(folder: Path) -> Path:
    """The host in the middle of its loop; its logger ends the recording."""
    subprocess.run([sys.executable, "-m", "tests.pictures.made", str(folder)], check=False)
    clock = MonotonicClock()
    give_up = clock.now() + _LOGGER_MAX_NS
    while not (folder / SUMMARY_FILE).exists():
        assert clock.now() < give_up, "its logger wrote no summary"
        clock.sleep_until(Instant(clock.now() + 20 * NS_PER_MS))
    return folder


def commissioning(folder: Path) -> Path:
    """A made-up drive, commissioned to the end."""
    hil("commission", "--bus", "simulated", "--node", "1", "--rehearse", "7", "--out", str(folder), "--yes")
    return folder


def comparison(folder: Path) -> Path:
    """Of a run with another one whose controller is eager."""
    eager = {"drive.axis1.controller.proportional_nm_s_rad": 0.2}
    folder.mkdir()
    runs = [
        run("ling2012.toml", changes)(folder / name) for name, changes in (("usual", {}), ("eager", eager))
    ]
    hil("compare", *map(str, runs), "--rrd", str(folder / "both.rrd"))
    return folder / "both.rrd"


def campaign(folder: Path) -> Path:
    """Of some short runs over a loss and a delay."""
    folder.mkdir()
    sweep = {
        "campaign": {"name": "short", "bench": str(EXAMPLES / "ling2012.toml"), "seeds": 3},
        "change": {
            "bench.duration_s": 0.6,
            "load": {},
            "faults": {"loss": [{"probability": 0.0}], "delay": [{"delay_us": 0}]},
            "verdict": {"dropouts_percent_max": 10.0, "speed_error_rms_rad_s_max": 4.0},
        },
        "vary": [
            {"key": "faults.loss.0.probability", "values": [0.0, 0.03, 0.1]},
            {"key": "faults.delay.0.delay_us", "values": [0, 300, 900]},
        ],
    }
    (folder / "sweep.toml").write_text(toml_text(sweep))
    hil("campaign", "run", str(folder / "sweep.toml"), "--out", str(folder / "out"), "--workers", "1")
    hil("campaign", "report", str(folder / "out"))
    return folder / "out"


def live(folder: Path) -> Path:
    """What the viewer has been sent of a run of 30 s that still goes on."""
    folder.mkdir()
    recorded = run("ling2012.toml", {"bench.duration_s": 30.0})(folder / "whole")
    plan = replace(plan_for(folder), name="ling2012")
    review = Review(plan.review)
    telemetry = Telemetry(plan, "live", rr.FileSink(folder / RERUN_FILE), live=True)
    telemetry.take_events([BeginEvent(Instant(0)), StateEvent(Instant(0), "phase", "running")])
    for rows in read_records(recorded / RECORDS_FILE):
        telemetry.take_rows(rows)
        review.add(rows)
    told = map(json.loads, (recorded / EVENTS_FILE).read_text().splitlines())
    texts = [TextEvent(each["at_ns"], each["level"], each["text"]) for each in told if "text" in each]
    telemetry.take_events([event for event in texts if event.at < review.figures().cycles * PERIOD])
    telemetry.show_running(review)
    telemetry.flush()
    return folder


def hil(*arguments: str, status: int = 0) -> None:
    """``hil ARGUMENTS``. Error: AssertionError if it ends with another status."""
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == status, done.output


def _killed_run(folder: Path) -> None:
    def kill(phase: str, elapsed_s: float) -> None:  # noqa: ARG001
        if elapsed_s >= _ENDED_AT_S:
            os.kill(os.getpid(), signal.SIGKILL)

    _outcome("ling2012.toml", {}, folder, kill, StopRequest())


if __name__ == "__main__":
    _killed_run(Path(sys.argv[1]))
