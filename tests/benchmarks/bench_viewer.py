"""What a viewer of a running bench costs its loop: ``hil run --view`` on the hub at 1 kHz, in turns.

    none      without --view
    gone      the viewer ends at once: there is no display
    follows   a viewer without a window draws all that comes, by software, on the cores of the bench
    slow      the same, but it runs for a tenth of the time
    stopped   the same, stopped for good a second and a half after it began

Processor time is that of the loop's process, from the begin of its cycles to their end; wake-ups and cycles
are the run's own records, dropouts those of the summary. Medians of ``--rounds``.
"""

import argparse
import os
import signal
import statistics
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Instant, MonotonicClock
from servobench.virtual_bus.child_python import python_command, python_environment
from tests.scenario.processes import EXAMPLES, hub_name, logger_of, loop_of, simulated_drive, start_run

CASES = ("none", "gone", "follows", "slow", "stopped")
SECONDS = 8.0
CYCLES = round(SECONDS * 1e3)
CLOCK = MonotonicClock()
TICKS = os.sysconf("SC_CLK_TCK")


class Figures(NamedTuple):
    """Of one run."""

    cpu_percent: float
    wake_p50_us: float
    wake_p99_us: float
    cycles_missed: int
    logger_mb: float


def main() -> None:
    """Print a table."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--rounds", type=int, default=5)
    rounds = arguments.parse_args().rounds
    found: dict[str, list[Figures]] = {case: [] for case in CASES}
    with tempfile.TemporaryDirectory() as folder, simulated_drive(hub_name("viewer")):
        bench = _bench(Path(folder))
        for number in range(rounds):
            for case in CASES:
                found[case].append(_run(bench, case, Path(folder) / f"{number}-{case}"))
    heads = ("CPU %", "x none", "wake p50", "p99 us", "missed", "logger MB")
    print(f"{'viewer':10}" + "".join(f"{head:>10}" for head in heads))
    base = statistics.median(each.cpu_percent for each in found["none"])
    for case, runs in found.items():
        cpu, p50, p99, missed, logger = (statistics.median(column) for column in zip(*runs, strict=True))
        print(f"{case:10}{cpu:10.1f}{cpu / base:10.2f}{p50:10.0f}{p99:10.0f}{missed:10.0f}{logger:10.0f}")


def _bench(folder: Path) -> Path:
    text = (EXAMPLES / "ling2012.toml").read_text(encoding="utf-8")
    text = text.replace("duration_s = 2.0", f"duration_s = {SECONDS}").replace(
        '"motors/', f'"{EXAMPLES}/motors/'
    )
    text = text[: text.index("[[load.")]
    path = folder / "bench.toml"
    path.write_text(text, encoding="utf-8")
    return path


def _run(bench: Path, case: str, folder: Path) -> Figures:
    options = [] if case == "none" else ["--view"]
    process = start_run(bench, hub_name("viewer"), folder, *options)
    while not (folder / "frames.arrow").exists():
        _sleep(0.05)
    loop, logger = loop_of(process.pid), logger_of(process.pid)
    with _viewer(case, logger):
        before, began = _cpu_s(loop), CLOCK.now()
        _sleep(SECONDS - 4.0)
        percent = 100.0 * (_cpu_s(loop) - before) / ((CLOCK.now() - began) / NS_PER_S)
        resident = _resident_mb(logger)
        told = process.communicate()[1]
    if "stopped" not in told:
        raise RuntimeError(told)
    with pa.ipc.open_file(folder / "records.arrow") as file:
        rows = file.read_all()
    late = rows["woke_at-due_at"].to_numpy() / NS_PER_US
    return Figures(
        percent,
        float(np.nanmedian(late)),
        float(np.nanquantile(late, 0.99)),
        CYCLES - rows.num_rows,
        resident,
    )


@contextmanager
def _viewer(case: str, logger: int) -> Iterator[None]:
    if case in ("none", "gone"):
        yield
        return
    port = _served_by(logger)
    options = ["--headless", "--bind", "127.0.0.1", "--port", "auto", "--window-size", "1920x1080"]
    with subprocess.Popen(
        python_command("rerun_cli", *options, "--connect", f"rerun+http://127.0.0.1:{port}/proxy"),
        env=python_environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as viewer:
        helper = _hinder(case, viewer.pid)
        try:
            _sleep(1.0)
            if not any(at == port and state == "01" for at, state, _ in _sockets()):
                raise RuntimeError("the viewer did not connect")
            yield
        finally:
            if helper is not None:
                helper.kill()
                helper.wait()
            with suppress(ProcessLookupError):
                os.killpg(viewer.pid, signal.SIGKILL)


def _hinder(case: str, group: int) -> "subprocess.Popen[bytes] | None":
    if case == "follows":
        return None
    forever = f"sleep 1.5; kill -STOP -- -{group}"
    if case == "slow":
        forever += f"; while :; do sleep .45; kill -CONT -- -{group}; sleep .05; kill -STOP -- -{group}; done"
    return subprocess.Popen(["sh", "-c", forever], stderr=subprocess.DEVNULL)


def _served_by(process: int) -> int:
    """The port on which it listens."""
    for _ in range(100):
        own = {os.readlink(each) for each in Path(f"/proc/{process}/fd").iterdir() if each.is_symlink()}
        for port, state, inode in _sockets():
            if state == "0A" and f"socket:[{inode}]" in own:
                return port
        _sleep(0.05)
    raise RuntimeError("the logger serves nobody")


def _sockets() -> Iterator[tuple[int, str, str]]:
    """Of this machine: local port, state in hexadecimal, inode."""
    for line in Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]:
        words = line.split()
        yield int(words[1].split(":")[1], 16), words[3], words[9]


def _sleep(seconds: float) -> None:
    CLOCK.sleep_until(Instant(CLOCK.now() + round(seconds * NS_PER_S)))


def _cpu_s(process: int) -> float:
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def _resident_mb(process: int) -> float:
    return (
        int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
        * os.sysconf("SC_PAGE_SIZE")
        / 1e6
    )


if __name__ == "__main__":
    main()
