"""``hil`` as processes on a bus in real time, for the tests of what a user would type."""

import json
import os
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import State, state_of
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, MonotonicClock
from servobench.drivers.wire.adapters import open_bus, parse_bus_spec
from servobench.drivers.wire.link import BusLink
from servobench.virtual_bus.bus.hub_place import HubPlace
from tests.warm.start import REAL_HIL, hil

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
BENCH = EXAMPLES / "any_bus.toml"
HIL = [REAL_HIL]
"""A process of its own from the first import on; :func:`hil` costs a tenth."""
RPM_PER_RAD_S = 60.0 / 6.283185307179586
VELOCITY_UNIT_RAD_S = 1e-3 / RPM_PER_RAD_S
START_LIMIT_S = 60.0
RUN_TIMEOUT_S = 90
REST_RAD_S = 0.5
_in_background: list[subprocess.Popen[str]] = []
NO_DISK = 99
"""Status of :func:`on_disk_of` where it cannot be."""
_ON_DISK = f"""
mount -t tmpfs -o size="$1" tmpfs "$2" || exit {NO_DISK}
disk=$2; kept=$3; shift 3
"$@"; status=$?
cp -a "$disk" "$kept"
exit $status
"""


def quiet_environment() -> dict[str, str]:
    """The environment of the tests without analytics of the viewer."""
    return {**os.environ, "CI": "true"}


def hub_name(test: str) -> str:
    """A hub of this test process alone."""
    return f"hub:{test}-{os.getpid()}"


@contextmanager
def simulated_drive(bus: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """``hil simulate`` on ``bus``, ready when entered, ended when left."""
    command = ["simulate", "--bus", bus, "--node", "1", *options]
    with serving(command, ends_with=(0, -signal.SIGKILL, 3)) as process:
        yield process


@contextmanager
def serving(command: Sequence[str], ends_with: Sequence[int] = (0,)) -> Iterator[subprocess.Popen[str]]:
    """A command of ``hil`` that serves until Ctrl-C: ready when entered, ended when left."""
    process = subprocess.Popen([*hil(), *command], stderr=subprocess.PIPE, text=True, env=quiet_environment())
    try:
        assert process.stderr is not None
        for line in process.stderr:
            if "Ctrl-C ends it" in line:
                break
        else:
            raise AssertionError(f"hil {command[0]} ended with {process.wait()}")
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=START_LIMIT_S)
        assert process.returncode in ends_with, said


def start_run(
    bench: Path, bus: str, folder: Path, *options: str, by: Sequence[str] = HIL
) -> subprocess.Popen[str]:
    """``hil run --json`` in the background, with the processes that a user's has; ``by`` :func:`hil`: forked,
    for a test that asks only what the command hears, says and leaves."""
    return in_background([*by, *_run_command(bench, bus, folder), *options])


def _run_command(bench: Path, bus: str, folder: Path) -> list[str]:
    return ["run", str(bench), "--bus", bus, "--record", str(folder), "--json"]


def in_background(
    command: Sequence[str],
    stdin: int | None = None,
    stdout: int = subprocess.PIPE,
    stderr: int = subprocess.PIPE,
) -> subprocess.Popen[str]:
    """A command whose outputs are read by the test; it ends with the test."""
    process = subprocess.Popen(
        command, stdin=stdin, stdout=stdout, stderr=stderr, text=True, env=quiet_environment()
    )
    _in_background.append(process)
    return process


def end_what_is_left() -> None:
    """What a test that failed has left behind ends."""
    while _in_background:
        process = _in_background.pop()
        if process.returncode is None:
            process.kill()
            process.communicate()


def on_disk_of(size: str, disk: Path, kept: Path, command: Sequence[str]) -> list[str]:
    """``command`` with a disk of ``size`` at ``disk``, whose content lies in ``kept`` afterwards.

    It is a tmpfs in a mount namespace of its own, for which nobody need be root.
    """
    return ["unshare", "-rm", "sh", "-c", _ON_DISK, "sh", size, str(disk), str(kept), *command]


def loop_of(command: int) -> int:
    """The process of a command's loop, whose parent is the command; waits until it is there."""
    clock = MonotonicClock()
    limit = clock.now() + round(START_LIMIT_S * NS_PER_S)
    while not (children := _children(command)):
        assert clock.now() < limit, "the command has no child"
        clock.sleep_until(Instant(clock.now() + NS_PER_MS))
    return children[0]


def family_of(command: int) -> list[int]:
    """The processes of a command: itself, its loop, and its logger."""
    return [command, *(each for child in _children(command) for each in family_of(child))]


def logger_of(command: int) -> int:
    """The process that records a run; ``command``: it, or its loop."""
    for child in _children(command):
        for process in (child, *_children(child)):
            if b"servobench.hil.recording.logger" in Path(f"/proc/{process}/cmdline").read_bytes():
                return process
    raise AssertionError("no logger runs")


def _children(process_id: int) -> list[int]:
    tasks = Path(f"/proc/{process_id}/task").iterdir()
    return [int(child) for task in tasks for child in (task / "children").read_text().split()]


def broker_of(bus: str) -> int:
    """The process behind a hub."""
    return int(HubPlace(bus.removeprefix("hub:")).alive.read_text())


def summary_of(folder: Path) -> dict[str, Any]:
    """Once it is there: whoever writes it may be a process that outlives the run."""
    clock = MonotonicClock()
    limit = clock.now() + 30 * NS_PER_S
    while not (folder / "summary.json").exists():
        assert clock.now() < limit, "no summary came"
        clock.sleep_until(Instant(clock.now() + 50 * NS_PER_MS))
    found: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return found


def run(bench: Path, bus: str, folder: Path, lasts_s: float = 0.0) -> tuple[int, dict[str, Any], str]:
    """``hil run --json`` to its end: exit status, summary ({} if there is none), what it said.

    ``lasts_s``: what the bench itself lasts, if that is long.
    """
    process = in_background([*hil(), *_run_command(bench, bus, folder)])
    out, said = process.communicate(timeout=RUN_TIMEOUT_S + lasts_s)
    return process.returncode, json.loads(out) if out.strip() else {}, said


def run_command(command: Sequence[str], folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """A command to its end, in ``folder``, its outputs as text."""
    return subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        env=quiet_environment(),
        timeout=RUN_TIMEOUT_S,
        check=False,
    )


def changed_bench(folder: Path, **values: object) -> Path:
    """examples/any_bus.toml in ``folder`` with other values of keys that it has once."""
    lines = BENCH.read_text(encoding="utf-8").replace('"motors/', f'"{EXAMPLES}/motors/').splitlines()
    for key, value in values.items():
        places = [number for number, line in enumerate(lines) if line.startswith(f"{key} = ")]
        assert len(places) == 1, f"{key} stands in {len(places)} lines"
        lines[places[0]] = f"{key} = {value}"
    path = folder / "changed.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def long_bench(folder: Path, duration_s: float = 60.0) -> Path:
    """A bench that turns for ``duration_s``, without injected faults."""
    return changed_bench(folder, duration_s=duration_s)


class Observer:
    """A second master that only reads: how fast the drive turns, and in which state it is."""

    def __init__(self, bus: str) -> None:
        self._clock = MonotonicClock()
        opened = open_bus(parse_bus_spec(bus), 1_000_000)
        self._bus = opened.bus
        self._network = CanopenNetwork(BusLink(opened.bus, self._clock, opened.stamps, bus), self._clock, 126)

    def velocity_rad_s(self) -> float:
        raw = self._upload(Object.VELOCITY_ACTUAL_VALUE)
        return int.from_bytes(raw, "little", signed=True) * VELOCITY_UNIT_RAD_S

    def state(self) -> State | None:
        return state_of(int.from_bytes(self._upload(Object.STATUSWORD), "little"))

    def _upload(self, index: int) -> bytes:
        """Answers to the other master that wait in the queue must not be taken for one's own."""
        self._network.pump(self._clock.now())
        return self._network.upload(1, index)

    def now(self) -> Instant:
        return self._clock.now()

    def wait(self, duration_s: float) -> None:
        """Let time pass, still taking frames in."""
        self._network.pump(Instant(self._clock.now() + round(duration_s * NS_PER_S)))

    def until_turning(
        self,
        speed_rad_s: float,
        limit_s: float = START_LIMIT_S,
        command: "subprocess.Popen[str] | None" = None,
    ) -> None:
        """Wait until the shaft turns at least that fast, or ``command``, which is to turn it, has ended."""
        deadline = self._clock.now() + round(limit_s * NS_PER_S)
        while abs(self.velocity_rad_s()) < speed_rad_s:
            assert self._clock.now() < deadline, "the drive never reached its speed"
            assert command is None or command.poll() is None, f"it ended first: {command.communicate()}"
            self.wait(0.01)

    def time_to_rest(self, since: Instant, limit_s: float) -> Duration:
        """From ``since`` until the shaft is at rest and the drive not enabled."""
        while True:
            at = self._clock.now()
            resting = abs(self.velocity_rad_s()) < REST_RAD_S
            if resting and self.state() is not State.OPERATION_ENABLED:
                return Duration(at - since)
            assert at - since < limit_s * NS_PER_S, f"still {self.state()} at {self.velocity_rad_s()} rad/s"
            self._network.pump(Instant(at + NS_PER_MS))

    def until(self, state: State, limit_s: float) -> None:
        """Wait until the drive is in ``state``: a quick stop ends a moment after the shaft rests."""
        deadline = self._clock.now() + round(limit_s * NS_PER_S)
        while (found := self.state()) is not state:
            assert self._clock.now() < deadline, f"still {found}, expected {state}"
            self.wait(0.001)

    def close(self) -> None:
        self._bus.shutdown()


@contextmanager
def observer(bus: str) -> Iterator[Observer]:
    """An observer on ``bus``."""
    watching = Observer(bus)
    try:
        yield watching
    finally:
        watching.close()
