"""Simulated drives as separate processes, for tests on a bus in real time."""

import itertools
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_MS, Instant, MonotonicClock, duration_s
from servobench.hil.configuration.bench_file import PathLike, faults_from, load_faults
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.configuration.motor_file import LING2012, MotorFile, load_motor
from servobench.hil.verdict.arguments import check_arguments
from servobench.virtual_bus.child_python import python_command, python_environment
from servobench.virtual_bus.hosting.injection import Faults

START_LIMIT_S = 60.0
END_LIMIT_S = 20.0
_ANNOUNCED = "Ctrl-C ends it"
_POLL_NS = 10 * NS_PER_MS


@dataclass(frozen=True, slots=True)
class DriveWish:
    """The drive that a test requests."""

    node: int = 1
    motor: MotorFile | PathLike = LING2012
    faults: PathLike | Mapping[str, Any] | None = None
    """A fault plan; its times count from the moment that the drive is on the bus."""
    eds: PathLike | None = None
    """EDS, DCF, XDD or XDC of the device to simulate."""
    store: PathLike | None = None
    """File for the stores of 1010h and LSS."""
    seed: int = 0
    bitrate_bit_s: int = 1_000_000

    def __post_init__(self) -> None:
        wish = {key: getattr(self, key) for key in self.__slots__}
        check_arguments("servo_drive", type(self), wish)

    @property
    def motor_file(self) -> MotorFile:
        """The motor, read if it is a path."""
        return self.motor if isinstance(self.motor, MotorFile) else load_motor(Path(self.motor))

    @property
    def plan(self) -> Faults | None:
        """The checked fault plan. Raises BadInput or BadInputs."""
        if self.faults is None:
            return None
        if isinstance(self.faults, Mapping):
            return faults_from(self.faults, "faults")
        return load_faults(Path(self.faults), NamedBy("faults", "", str(self.faults)))


class DriveProcess:
    """``hil simulate``: on the bus when made, ended by ``stop``, ``kill``, or the end of the test."""

    def __init__(self, command: Sequence[str], log: Path) -> None:
        self._log = log
        self._forgiven = False
        with log.open("wb") as said:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                env=python_environment(CI="true"),
            )
        self._await_announcement()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def said(self) -> str:
        """Its output so far."""
        return self._log.read_text(encoding="utf-8", errors="replace")

    def kill(self) -> None:
        """End it as a pulled plug would: without notice (SIGKILL)."""
        self._forgiven = True
        self._process.kill()
        self._process.wait(END_LIMIT_S)

    def stop(self) -> int:
        """End it by Ctrl-C; return its exit status."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        return self.wait()

    def wait(self, limit_s: float = END_LIMIT_S) -> int:
        """Wait until it ends by itself; return its exit status."""
        status = self._process.wait(limit_s)
        self._forgiven = True
        return status

    def finish(self) -> str:
        """End it if necessary; return its output if it ended by an error that no test has requested, else
        ''."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(END_LIMIT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
                return f"it did not end within {END_LIMIT_S:g} s of Ctrl-C; it said:\n{self.said}"
        if self._process.returncode and not self._forgiven:
            return f"it ended with status {self._process.returncode}; it said:\n{self.said}"
        return ""

    def _await_announcement(self) -> None:
        clock = MonotonicClock()
        deadline = clock.now() + duration_s(START_LIMIT_S)
        while _ANNOUNCED not in self.said:
            if self._process.poll() is not None or clock.now() > deadline:
                self._process.kill()
                self._process.wait()
                raise PeerFault("the simulated drive did not come up", self.said.strip())
            clock.sleep_until(Instant(clock.now() + _POLL_NS))


class DriveHost:
    """The drive processes of one test."""

    def __init__(self, spec: str, scratch: Path, present: bool = False) -> None:
        """``scratch``: a folder of the test, for the processes' files. ``present``: the drives of the tests
        are on the bus already, and do not belong to this host."""
        self.spec = spec
        self.present = present
        self.nodes: set[int] = set()
        """Nodes that are or were on the bus."""
        self._scratch = scratch
        self._processes: list[DriveProcess] = []
        self._numbers = itertools.count(1)

    def missing(self, nodes: Sequence[int]) -> list[int]:
        """Return those of ``nodes`` that have to be started."""
        return [] if self.present else [node for node in nodes if node not in self.nodes]

    def start(
        self, nodes: Sequence[int], wish: DriveWish, loads: Mapping[int, str] = MappingProxyType({})
    ) -> DriveProcess:
        """Start drives of one kind, whatever the node of the wish; ``loads``: by node, the file of a load
        over time. Raises PeerFault with its output if it fails."""
        number = next(self._numbers)
        options = ["--bus", self.spec, "--node", ",".join(map(str, nodes))]
        options += ["--motor", str(self._file(f"motor-{number}.toml", wish.motor))]
        options += ["--seed", str(wish.seed), "--bitrate", str(wish.bitrate_bit_s)]
        if wish.faults is not None:
            options += ["--faults", str(self._file(f"faults-{number}.toml", wish.faults))]
        options += ["--eds", str(wish.eds)] if wish.eds is not None else []
        options += ["--store", str(wish.store)] if wish.store is not None else []
        for node, path in loads.items():
            options += ["--load", f"{node}={path}"]
        log = self._scratch / f"drive-{number}.log"
        process = DriveProcess(python_command("servobench.hil.cli", "simulate", *options), log)
        self._processes.append(process)
        self.nodes.update(nodes)
        return process

    def end(self) -> None:
        """End them all. Raises PeerFault if one had ended by its own error."""
        complaints = [complaint for process in self._processes if (complaint := process.finish())]
        self._processes.clear()
        if complaints:
            raise PeerFault(f"a simulated drive on {self.spec} failed", "\n".join(complaints))

    def _file(self, name: str, content: MotorFile | Mapping[str, Any] | PathLike) -> Path:
        """Return a file that holds ``content``; a path names an existing one."""
        if isinstance(content, str | os.PathLike):
            return Path(content)
        tables = content.tables if isinstance(content, MotorFile) else content
        path = self._scratch / name
        path.write_text(toml_text(tables), encoding="utf-8")
        return path
