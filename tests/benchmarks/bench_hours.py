"""What a recording costs whoever reads it: ten minutes and an hour, one axis and three, at 1 kHz.

Each is a run of an example in simulated time, with its losses. Figures are processor time, s, and the largest
resident set, MB, of each command as a process of its own, with the processes that it starts; of ``picture``
the time on the clock counts, as the viewer is a process that nobody waits for.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.rows.run_files import FRAMES_FILE, RECORDS_FILE, RERUN_FILE
from tests.scenario.processes import EXAMPLES

_WINDOW_S: Final = 0.003
_BENCHES: Final = {1: "ling2012.toml", 3: "three_axes.toml"}


class Cost(NamedTuple):
    """Of one command."""

    processor_s: float
    clock_s: float
    peak_mb: float
    status: int


def cost(*arguments: str) -> Cost:
    """Of ``hil ARGUMENTS``."""
    clock = MonotonicClock()
    began = clock.now()
    command = [sys.executable, "-m", "servobench.hil.cli", *arguments]
    started = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(started.pid, 0)
    started.returncode = os.waitstatus_to_exitcode(status)
    clock_s = (clock.now() - began) / NS_PER_S
    return Cost(usage.ru_utime + usage.ru_stime, clock_s, usage.ru_maxrss / 1024, started.returncode)


def bench_of(axes: int, minutes: int, folder: Path) -> Path:
    """An example that lasts so long."""
    text = (EXAMPLES / _BENCHES[axes]).read_text(encoding="utf-8")
    for below in ("motors", "faults"):
        text = text.replace(f'"{below}/', f'"{EXAMPLES}/{below}/')
    lines = [
        f"duration_s = {60.0 * minutes}" if line.startswith("duration_s") else line
        for line in text.splitlines()
    ]
    path = folder / f"{axes}-{minutes}.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def readers(run: Path, minutes: int) -> Iterator[tuple[str, tuple[str, ...]]]:
    """What is done with a recording, by name."""
    there, end_s = str(run), 60.0 * minutes - 1.0
    yield "why", ("why", there)
    yield "trace, 3 ms", ("trace", there, "--from", f"{end_s}", "--to", f"{end_s + _WINDOW_S}")
    yield "trace, whole", ("trace", there)
    yield "review", ("review", there)
    yield "compare", ("compare", there, there)
    yield "picture", ("picture", there, str(run / "page.png"))
    yield "picture --paper", ("picture", there, str(run / "paper.png"), "--paper")
    yield "export parquet", ("export", there, "--to", "parquet", "--out", str(run / "out.parquet"))
    yield "export csv", ("export", there, "--to", "csv", "--out", str(run / "out.csv"))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.bench_hours", description=__doc__)
    parser.add_argument("--minutes", type=int, nargs="+", default=[10, 60])
    parser.add_argument("--axes", type=int, nargs="+", default=[1, 3], choices=list(_BENCHES))
    asked = parser.parse_args()
    print(f"{'':22} {'command':16} {'CPU s':>8} {'clock s':>8} {'MB':>6}  status")
    for minutes in asked.minutes:
        for axes in asked.axes:
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                run = folder / "run"
                what = f"{minutes} min, {axes} {'axis' if axes == 1 else 'axes'}"
                recorded = cost("run", str(bench_of(axes, minutes, folder)), "--record", str(run))
                _tell(what, "run", recorded)
                for file in (RECORDS_FILE, FRAMES_FILE, RERUN_FILE):
                    print(
                        f"{what:22} {file:16} {'':8} {'':8} {(run / file).stat().st_size / 1e6:6.0f}  on disk"
                    )
                for command, arguments in readers(run, minutes):
                    _tell(what, command, cost(*arguments))


def _tell(what: str, command: str, of: Cost) -> None:
    figures = f"{of.processor_s:8.1f} {of.clock_s:8.1f} {of.peak_mb:6.0f}  {of.status}"
    print(f"{what:22} {command:16} {figures}", flush=True)


if __name__ == "__main__":
    main()
