"""One cell of the table: the processes of a run, what befalls one of them, and what is left of it."""

import itertools
import os
import select
import signal
import subprocess
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, MonotonicClock
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.loop.cycle_record import FATE_MISSED
from servobench.hil.rows.run_files import RECORDS_FILE
from servobench.hil.testing.hosted import DriveProcess
from servobench.hil.verdict.verdict import ExitStatus, VerdictKind
from servobench.virtual_bus.child_python import python_command, python_environment
from tests.exits.cells import (
    BROKER,
    CONNECTING,
    DISK,
    DRIVE,
    FULL,
    HOST,
    HUB,
    KILL,
    LOGGER,
    SLOW,
    STOP,
    TERMINATE,
    Cell,
    statuses,
)
from tests.exits.written_witness import WrittenTestimony
from tests.scenario.processes import (
    BENCH,
    RUN_TIMEOUT_S,
    broker_of,
    hub_name,
    logger_of,
    on_disk_of,
    summary_of,
)
from tests.swarm.mishaps import Circumstances, Mishap
from tests.swarm.ran import Ran, Told

DURATION_S: Final = 1.0
STOPPED_NS: Final = 1500 * NS_PER_MS
"""Longer than a drive waits for its host's heartbeat, and a host for its drive's."""
REST_LIMIT_S: Final = 3.0
TELLING_NS: Final = 200 * NS_PER_MS
"""In real time an error takes a while from a bus that is gone to the reader."""
DISK_SIZE: Final = "16m"
_SIGNALS: Final = {KILL: signal.SIGKILL, STOP: signal.SIGSTOP, TERMINATE: signal.SIGTERM}
_MISHAPS: Final = {
    (HOST, KILL): Mishap.HOST_KILLED,
    (LOGGER, KILL): Mishap.LOGGER_KILLED,
    (DISK, FULL): Mishap.DISK_FULL,
    (DISK, SLOW): Mishap.DISK_SLOW,
}
_CONTROLLERS: Final = {
    "csv": {"kind": "position", "made_for": {"delay_us": 10_000, "speed_bandwidth_hz": 30}},
    "csp": {"kind": "stream"},
}
_POLL_NS: Final = NS_PER_MS
_NUMBERS: Final = itertools.count()


@dataclass(frozen=True)
class Ended:
    """A cell that was run."""

    cell: Cell
    struck_at: Instant | None
    """On the clock of the bench; None: the run never came to the phase."""
    rest: Duration | None
    """From then until the drive was at rest for good; None: it was not seen to be."""
    ran: Ran

    @property
    def rows_told_lost(self) -> bool:
        """The summary says that rows are missing in their file."""
        told = self.ran.told
        lacks = any(fault.startswith(RECORDS_FILE) for fault in told.get("recording_faults", ()))
        return lacks and any(
            found["outcome"] == VerdictKind.NOT_RECORDED for found in told["verdict"]["findings"]
        )

    @property
    def lost(self) -> int:
        """Cycles whose SYNC came to the enabled drive, and that have no row."""
        (drive,) = self.ran.case.drives
        assert isinstance(drive, WrittenTestimony)
        return max(0, drive.cycles - int(np.sum(self.ran.rows["fate"] != FATE_MISSED)))


def config(mode: str) -> BenchConfig:
    """A second in which the shaft turns, and of which nothing is asked that a disturbance could break."""
    tables = tomllib.loads(BENCH.read_text(encoding="utf-8"))
    tables["bench"]["duration_s"] = DURATION_S
    tables["host"]["connect_timeout_s"] = 3.0
    # a cycle is recorded when its fate is known: after so many periods at the latest
    tables["loop"]["horizon_periods"] = 5
    level: dict[str, float] = {"speed_rpm": 600.0, "over_s": 0.2}
    if mode != "cst":
        level = {"position_rad": 60.0, "over_s": 1.0}
        tables["drive"]["axis1"] |= {"mode": mode, "controller": _CONTROLLERS[mode]}
    tables["reference"] = {"axis1": [{"at_s": 0.0, "kind": "ramp", **level}]}
    tables["verdict"] = {"dropouts_percent_max": 100.0}
    del tables["load"]
    return bench_from(tables, "exits", BENCH.parent)


class Host:
    """``hil run``, which stands still until the drive is there, and where it enters the phase of its cell."""

    def __init__(self, cell: Cell, bus: str, folder: Path) -> None:
        bench, self._disk, kept = folder / "bench.toml", folder / "disk", folder / "kept"
        bench.write_text(config(cell.mode).resolved_text(), encoding="utf-8")
        self._disk.mkdir()
        self.slow, self.witness = folder / "slow", folder / "witness"
        self._told, told = os.pipe()
        answer, self._answer = os.pipe()
        options = [cell.phase, str(told), str(answer), str(self.witness), str(self.slow)]
        run = ["run", str(bench), "--bus", bus, "--record", str(self._disk / "run"), "--json"]
        command = python_command("tests.exits.held_host", *options, *run)
        self.folder = self._disk / "run"
        if cell.deed == FULL:
            command, self.folder = on_disk_of(DISK_SIZE, self._disk, kept, command), kept / "run"
        self.process = subprocess.Popen(
            command,
            pass_fds=(told, answer),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=python_environment(CI="true"),
        )
        os.close(told)
        os.close(answer)

    def await_phase(self) -> Instant | None:
        """The instant on the bench's clock when it is there; None if it ended before."""
        assert select.select([self._told], [], [], RUN_TIMEOUT_S)[0], "it never came to its phase"
        told = os.read(self._told, 64)
        return Instant(int(told)) if told else None

    def go_on(self, *, fill: bool = False) -> None:
        """Let it; ``fill``: its disk is full from now on."""
        with suppress(BrokenPipeError):
            os.write(self._answer, f"{self._disk / 'filler' if fill else ''}\n".encode())

    def close(self) -> None:
        """It has ended."""
        os.close(self._told)
        os.close(self._answer)


def run_cell(cell: Cell, folder: Path) -> Ended:
    """Run a cell; its files go into ``folder``, which is empty."""
    bus = hub_name(f"exits{next(_NUMBERS)}") if cell.bus == HUB else cell.bus
    host = Host(cell, bus, folder)
    try:
        if cell.bus == HUB:
            with drive_on(bus, host.witness, folder / "drive.log") as drive:
                return _run(cell, host, bus, drive)
        return _run(cell, host, bus, None)
    finally:
        host.process.kill()
        host.process.communicate()
        host.close()


@contextmanager
def drive_on(bus: str, witness: Path, log: Path) -> Iterator[DriveProcess]:
    """A drive as a process, whose witness writes into a file."""
    command = ["tests.exits.watched_drive", str(witness), "simulate", "--bus", bus, "--node", "1"]
    drive = DriveProcess(python_command(*command), log)
    try:
        yield drive
    finally:
        drive.finish()


def _run(cell: Cell, host: Host, bus: str, drive: DriveProcess | None) -> Ended:
    struck_at = host.await_phase()
    if cell.phase != CONNECTING:
        host.go_on()
        struck_at = host.await_phase()
    held = Duration(0) if struck_at is None else _strike(cell, host, bus, drive)
    out, said = host.process.communicate(timeout=RUN_TIMEOUT_S)
    status: int | None = host.process.returncode
    if status == -signal.SIGKILL:
        status = None
        summary_of(host.folder)  # by whoever is left to write it
    rest = None if struck_at is None else _await_rest(host.witness, drive, struck_at)
    mishap = _MISHAPS.get((cell.victim, cell.deed), Mishap.NONE)
    killed_at = struck_at if mishap is Mishap.HOST_KILLED else None
    told = Told(status, out, said, [WrittenTestimony(1, host.witness)], killed_at)
    around = Circumstances(mishap, 0.0, 0, ())
    bench = config(cell.mode)
    may_end_with = statuses(cell)
    if drive is not None and held >= (bench.host.heartbeat_timeout_ms - bench.host.heartbeat_ms) * NS_PER_MS:
        may_end_with = (*may_end_with, ExitStatus.PEER_FAULT)
    ran = Ran(bench, around, host.folder, told, may_end_with, TELLING_NS)
    return Ended(cell, struck_at, rest, ran)


def _strike(cell: Cell, host: Host, bus: str, drive: DriveProcess | None) -> Duration:
    """Returns for how long the host stood still: a drive that missed its heartbeats has stopped itself, and
    that is told in the place of what befell another process."""
    clock = MonotonicClock()
    since = clock.now()
    if cell.victim == DISK:
        if cell.deed == SLOW:
            host.slow.touch()
        host.go_on(fill=cell.deed == FULL)
        return Duration(clock.now() - since)
    victim = _process_id(cell.victim, host, bus, drive)
    os.kill(victim, _SIGNALS[cell.deed])
    struck_at = clock.now()
    while cell.deed == KILL and _lives(victim):
        clock.sleep_until(Instant(clock.now() + _POLL_NS))
    host.go_on()
    held = Duration(clock.now() - since)
    if cell.deed == STOP:
        clock.sleep_until(Instant(struck_at + STOPPED_NS))
        os.kill(victim, signal.SIGCONT)
    return held


def _process_id(victim: str, host: Host, bus: str, drive: DriveProcess | None) -> int:
    if victim == LOGGER:
        return logger_of(host.process.pid)
    if victim == BROKER:
        return broker_of(bus)
    if victim == DRIVE:
        assert drive is not None
        return drive.pid
    assert victim == HOST
    return host.process.pid


def _lives(process_id: int) -> bool:
    try:
        text = Path(f"/proc/{process_id}/stat").read_text()
    except OSError:
        return False
    return text.rpartition(")")[2].split()[0] != "Z"


def _await_rest(witness: Path, drive: DriveProcess | None, since: Instant) -> Duration | None:
    clock = MonotonicClock()
    limit = clock.now() + round(REST_LIMIT_S * NS_PER_S)
    while True:
        rest = WrittenTestimony(1, witness).time_to_rest(since)
        if rest is not None or drive is None or not _lives(drive.pid) or clock.now() > limit:
            return rest
        clock.sleep_until(Instant(clock.now() + _POLL_NS))
