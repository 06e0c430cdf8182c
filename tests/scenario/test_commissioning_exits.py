"""Every way out of a commissioning on a hub ends in rest; the journal of a killed one puts the drive back."""

import os
import signal
import subprocess
import termios
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.profile import State, state_of
from servobench.drivers.errors import TransferAborted
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, MonotonicClock
from servobench.drivers.wire.adapters import open_bus, parse_bus_spec
from servobench.drivers.wire.link import BusLink
from servobench.hil.commissioning.report import REPORT_FILE
from servobench.hil.restoring.journal import read_journal
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.draws import few_of
from tests.motors import LING
from tests.scenario.processes import (
    HIL,
    REST_RAD_S,
    START_LIMIT_S,
    VELOCITY_UNIT_RAD_S,
    broker_of,
    hub_name,
    in_background,
    loop_of,
    run_command,
    simulated_drive,
)
from tests.warm.start import hil

pytestmark = pytest.mark.xdist_group("real time")

TURNING_RAD_S = 8.0
"""Reached in the pulses that come first."""
TIMEOUT_MS = 600
"""Of the heartbeats: two shared cores."""
STOP_S = 0.3
"""From the fastest of an exercise at the drive's default 6085h."""
MARGIN_S = 1.5
_READ = (0x43, 0x47, 0x4B, 0x4F)
_VOLATILE = frozenset({0x1003, 0x1013, 0x6040})
"""History, clock and command."""


class Witness:
    """Listens to the bus, and asks the drive itself only once the host is gone."""

    def __init__(self, bus: str, by_speeds: bool = False) -> None:
        """``by_speeds``: 606Ch comes first in TPDO2, as a drive that is given speeds has it."""
        self.by_speeds = by_speeds
        self._clock = MonotonicClock()
        opened = open_bus(parse_bus_spec(bus), 1_000_000)
        self._bus = opened.bus
        link = BusLink(opened.bus, self._clock, opened.stamps, bus)
        link.tap(self._see)
        self.network = CanopenNetwork(link, self._clock, 126)
        self.speed_rad_s = 0.0
        self.state: State | None = None
        self.disabled_at: Instant | None = None

    def _see(self, _way: str, can_id: int, data: bytes, _extended: bool, _remote: bool, at: Instant) -> None:
        if can_id == 0x181 and len(data) == 8:
            self._note(int.from_bytes(data[:2], "little"), at)
            if not self.by_speeds:
                self.speed_rad_s = int.from_bytes(data[2:6], "little", signed=True) * VELOCITY_UNIT_RAD_S
        elif can_id == 0x281 and self.by_speeds:
            self.speed_rad_s = int.from_bytes(data[:4], "little", signed=True) * VELOCITY_UNIT_RAD_S
        elif can_id == 0x581 and data[0] in _READ and data[1:4] == b"\x41\x60\x00":
            self._note(int.from_bytes(data[4:6], "little"), at)
        elif can_id == 0x581 and data[0] in _READ and data[1:4] == b"\x6c\x60\x00":
            self.speed_rad_s = int.from_bytes(data[4:8], "little", signed=True) * VELOCITY_UNIT_RAD_S

    def _note(self, statusword: int, at: Instant) -> None:
        self.state = state_of(statusword)
        resting = self.state not in (State.OPERATION_ENABLED, State.QUICK_STOP)
        if resting and self.disabled_at is None and abs(self.speed_rad_s) < REST_RAD_S:
            self.disabled_at = at
        if self.state is State.OPERATION_ENABLED:
            self.disabled_at = None

    def now(self) -> Instant:
        return self._clock.now()

    def until_turning(self) -> None:
        """Listen until the shaft turns in one of the host's exercises."""
        deadline = self.now() + round(START_LIMIT_S * NS_PER_S)
        while abs(self.speed_rad_s) < TURNING_RAD_S:
            assert self.now() < deadline, "the shaft never turned"
            self.network.pump(Instant(self.now() + 2_000_000))

    def time_to_rest(self, since: Instant, limit_s: float, *, asking: bool) -> Duration:
        """Until the drive is seen disabled and at rest; ``asking``: there is no host that would tell."""
        while self.disabled_at is None or self.disabled_at < since:
            assert self.now() - since < limit_s * NS_PER_S, f"{self.state} at {self.speed_rad_s} rad/s"
            if asking:
                self.network.upload(1, 0x606C)
                self.network.upload(1, 0x6041)
            self.network.pump(Instant(self.now() + 1_000_000))
        took = Duration(self.disabled_at - since)
        print(f"disabled and at rest after {took / NS_PER_MS:.0f} ms")  # pytest -rP shows it
        return took

    def memory(self) -> dict[tuple[int, int], bytes]:
        """What a master could have changed, as the drive tells it."""
        held = {}
        for entry in SimulatedServo(1, LING).dictionary:
            for sub, variable in entry.members.items():
                if variable.writable and variable.readable and entry.index not in _VOLATILE:
                    try:
                        held[entry.index, sub] = self.network.upload(1, entry.index, sub)
                    except TransferAborted:
                        continue
        return held

    def close(self) -> None:
        self._bus.shutdown()


@contextmanager
def witness(bus: str, by_speeds: bool = False) -> Iterator[Witness]:
    watching = Witness(bus, by_speeds)
    try:
        yield watching
    finally:
        watching.close()


def command(bus: str, out: Path, by: Sequence[str] = HIL) -> list[str]:
    return [
        *by, "commission", "--bus", bus, "--node", "1", "--out", str(out), "--yes",
        "--period-us", "4000", "--heartbeat-timeout-ms", str(TIMEOUT_MS),
    ]  # fmt: skip


def start(
    bus: str, out: Path, stdin: int = subprocess.DEVNULL, by: Sequence[str] = HIL
) -> subprocess.Popen[str]:
    """By :func:`hil`: forked, where it is neither stopped nor killed, nor has a terminal."""
    return in_background(command(bus, out, by), stdin, subprocess.DEVNULL)


def restore(out: Path) -> subprocess.CompletedProcess[str]:
    return run_command([*hil(), "restore", str(out / "journal.jsonl")])


@pytest.mark.parametrize("number", few_of([signal.SIGTERM, signal.SIGINT], 1))
def test_a_stop_signal_ends_in_rest_with_everything_put_back(tmp_path: Path, number: signal.Signals) -> None:
    bus = hub_name(f"commission-{number.name.lower()}")
    with simulated_drive(bus), witness(bus) as watching:
        before = watching.memory()
        process = start(bus, tmp_path, by=hil())
        watching.until_turning()
        at = watching.now()
        process.send_signal(number)
        took = watching.time_to_rest(at, STOP_S + MARGIN_S, asking=False)
        _, said = process.communicate(timeout=30)
        assert process.returncode == 130, said
        assert took > 0
        assert watching.memory() == before
    assert read_journal(tmp_path / "journal.jsonl").restored
    assert number.name in (tmp_path / REPORT_FILE).read_text()


def test_any_key_is_an_emergency_stop(tmp_path: Path) -> None:
    bus = hub_name("commission-key")
    keyboard, terminal = os.openpty()
    settings = termios.tcgetattr(terminal)
    try:
        with simulated_drive(bus), witness(bus) as watching:
            before = watching.memory()
            process = start(bus, tmp_path, terminal)
            watching.until_turning()
            at = watching.now()
            os.write(keyboard, b" ")
            watching.time_to_rest(at, STOP_S + MARGIN_S, asking=False)
            _, said = process.communicate(timeout=30)
            assert process.returncode == 3, said
            assert "emergency stop by a key" in said
            assert watching.memory() == before
        assert termios.tcgetattr(terminal) == settings, "the terminal is as it was"
    finally:
        os.close(keyboard)
        os.close(terminal)


@pytest.mark.parametrize("number", few_of([signal.SIGKILL, signal.SIGSTOP], 1))
def test_a_host_that_is_gone_is_put_back_by_its_journal(tmp_path: Path, number: signal.Signals) -> None:
    bus = hub_name(f"commission-{number.name.lower()}")
    with simulated_drive(bus), witness(bus) as watching:
        before = watching.memory()
        process = start(bus, tmp_path)
        watching.until_turning()
        loop = loop_of(process.pid)
        at = watching.now()
        os.kill(process.pid if number == signal.SIGKILL else loop, number)
        took = watching.time_to_rest(at, 1e-3 * TIMEOUT_MS + STOP_S + MARGIN_S, asking=True)
        assert took > 0.05 * NS_PER_S, "it stopped before it could have known"
        process.kill()
        process.communicate(timeout=20)
        assert watching.memory() != before
        again = run_command(command(bus, tmp_path, hil()))
        assert again.returncode == 2, again.stderr
        assert "hil restore" in again.stderr, "a journal that waits forbids another commissioning over it"
        done = restore(tmp_path)
        assert done.returncode == 0, done.stderr
        assert "byte for byte" in done.stderr
        assert watching.memory() == before


def test_a_command_that_is_gone_has_its_drive_stopped_by_its_parent(tmp_path: Path) -> None:
    bus = hub_name("commission-gone")
    with simulated_drive(bus), witness(bus) as watching:
        before = watching.memory()
        process = start(bus, tmp_path)
        watching.until_turning()
        os.kill(loop_of(process.pid), signal.SIGKILL)
        _, said = process.communicate(timeout=30)
        assert process.returncode == 6, said
        assert "hil: error: the process of hil commission was ended by SIGKILL" in said
        assert "hil: node 1: at rest and" in said
        assert f"hil restore {tmp_path}/journal.jsonl puts back" in said
        watching.time_to_rest(watching.now(), 0.1, asking=True)
        assert restore(tmp_path).returncode == 0
        assert watching.memory() == before


def test_a_lost_bus_ends_it_and_names_what_puts_things_back(tmp_path: Path) -> None:
    bus = hub_name("commission-lost")
    with simulated_drive(bus) as drive:
        with witness(bus) as watching:
            process = start(bus, tmp_path, by=hil())
            watching.until_turning()
        os.kill(broker_of(bus), signal.SIGKILL)
        _, said = process.communicate(timeout=30)
        assert process.returncode == 3, said
        assert "Traceback" not in said
        assert f"hil restore {tmp_path / 'journal.jsonl'}" in said
        assert "may hold other values than before" in (tmp_path / REPORT_FILE).read_text()
        assert drive.wait(timeout=20) == 3


@pytest.mark.parametrize("number", few_of([signal.SIGTERM, signal.SIGKILL], 1))
def test_a_jog_that_is_ended_leaves_its_drive_at_rest(tmp_path: Path, number: signal.Signals) -> None:
    """By a signal it puts everything back; where its process is killed, its parent has the drive stopped."""
    bus = hub_name(f"jog-{number.name.lower()}")
    with simulated_drive(bus), witness(bus, by_speeds=True) as watching:
        before = watching.memory()
        jog = [
            *HIL, "jog", "--bus", bus, "--node", "1", "--out", str(tmp_path), "--yes", "--turns", "-500",
            "--rpm", "150", "--heartbeat-timeout-ms", str(TIMEOUT_MS),
        ]  # fmt: skip
        process = in_background(jog, subprocess.DEVNULL, subprocess.DEVNULL)
        watching.until_turning()
        at = watching.now()
        os.kill(process.pid if number == signal.SIGTERM else loop_of(process.pid), number)
        watching.time_to_rest(at, 1e-3 * TIMEOUT_MS + STOP_S + MARGIN_S, asking=number == signal.SIGKILL)
        _, said = process.communicate(timeout=30)
        assert process.returncode == (130 if number == signal.SIGTERM else 6), said
        if number == signal.SIGKILL:
            assert "hil: node 1: at rest and" in said
            assert restore(tmp_path).returncode == 0
        assert watching.memory() == before
