"""One data sheet through ``hil eds``, ``hil commission`` and ``hil run``; ``hil simulate`` is the drive, in a
process of its own, and the witness stands between them."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from servobench.drivers.timebase import NS_PER_S, Instant, MonotonicClock
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.configuration.motor_file import LING2012
from servobench.virtual_bus.drive.unknown_drive import nameplate_of
from tests.rehearsals.rehearsal import fault_options
from tests.witness.frames import Access, Frame, NodeListener
from tests.witness.lateness import lateness
from tests.witness.witness import Described, Key, Witness, described

NODE: Final = 1
PERIOD_US: Final = 4000
"""A quarter of the usual load: six cases side by side keep their cycle on two cores. With 10 ms a ramp of
speeds or positions no longer tells the inertia."""
COUNTS: Final = 65536
"""Of the simulated drive's encoder: what its owner reads off it."""
HEARTBEAT_TIMEOUT_MS: Final = 2000
"""A process of a machine with ten others for each core was kept waiting for half a second."""
_ATTEMPTS_MAX: Final = 3
_START_S: Final = 300.0
_COMMAND_S: Final = 900.0
"""Both bound a process that hangs; one that works takes a twentieth of it."""
_MOTOR: Final = Path(__file__).parents[2] / "examples" / "motors" / "ling2012.toml"
_NOT_ENABLED: Final = frozenset({0x00, 0x40, 0x21, 0x23, 0x08})
"""6041h masked with 6Fh, and 4Fh: no torque (CiA 402-2, states); ready, switched on, disabled, fault."""


@dataclass
class Ended:
    """One command that came to its end."""

    options: tuple[str, ...]
    status: int
    figures: dict[str, Any]
    """Of --json; empty if it printed none."""
    text: str
    """What it said on stderr."""
    late: str = ""
    """What the machine had no time for meanwhile, by the frames; empty if nothing."""

    @property
    def reason(self) -> str:
        """Why it did not do what it was asked; empty if it did."""
        if (
            self.status == 0 or self.figures.get("error", "") is None
        ):  # steps failed: each has a reason of its own
            return ""
        told = self.figures.get("error") or self.figures.get("verdict", {}).get("reason")
        errors = [line for line in self.text.splitlines() if line.startswith("hil: ")]
        return str(told or " ".join(errors[-1:]) or self.text[-300:])


@dataclass
class Case:
    """What came of one sheet."""

    sheet: Path
    variables: dict[Key, Described]
    eds: Ended
    commissions: list[Ended] = field(default_factory=list)
    """One after the other: each does what the one before advised."""
    run: Ended | None = None
    held: dict[Key, bytes] = field(default_factory=dict)
    """All that could be read of the drive before any command."""
    accesses: dict[str, list[Access]] = field(default_factory=dict)
    """Of each command, in the order of the frames."""
    unexplained: set[int] = field(default_factory=set)
    changed: list[str] = field(default_factory=list)
    """Settings that are not as they were before the command."""
    left: list[str] = field(default_factory=list)
    """What is wrong with how a command left the drive."""
    frames: int = 0
    seconds: float = 0.0

    @property
    def carried(self) -> set[Key]:
        """What the drive's own RPDO mappings have: a fixed one has to be sent with what its objects hold."""
        mappings = [key for key in self.held if 0x1600 <= key[0] < 0x1800 and key[1]]
        words = [int.from_bytes(self.held[key], "little") for key in mappings]
        return {(word >> 16, word >> 8 & 0xFF) for word in words}

    @property
    def commission(self) -> Ended:
        """The last one."""
        return self.commissions[-1]


def tried(sheet: Path, folder: Path, hub: str) -> Case:
    """All three commands; ``folder`` keeps what they leave and the log of the frames."""
    clock = MonotonicClock()
    began = clock.now()
    case = Case(sheet, described(sheet), _ended(["eds", str(sheet), "--json"], folder / "eds"))
    bus = ["--bus", f"hub:{hub}"]
    drive = [*bus, "--node", str(NODE), "--eds", str(sheet), *fault_options(folder)]
    with Witness(hub, NODE) as witness, _simulated(drive, folder):
        observed = _Observed(case, witness, folder)
        plate: dict[str, Any] = nameplate_of(LING2012.parameters)
        options: list[str] = []
        for attempt in range(_ATTEMPTS_MAX):
            out = folder / f"commissioned{attempt}"
            (folder / "plate.toml").write_text(toml_text(plate))
            asked = ["commission", *bus, "--node", str(NODE), "--eds", str(sheet), "--yes", "--json"]
            asked += [
                "--motor",
                str(folder / "plate.toml"),
                "--out",
                str(out),
                "--period-us",
                str(PERIOD_US),
                "--heartbeat-timeout-ms",
                str(HEARTBEAT_TIMEOUT_MS),
            ]
            case.commissions.append(observed.command("commission", [*asked, *options], tuple(options)))
            if not _advised(case.commission.reason, plate, options):
                break
        bench = out / "bench.toml"
        if not bench.exists():
            bench = _own_bench(folder, sheet, hub, mode_to_run(case.eds), _scale(out))
        asked = ["run", str(bench), *bus, "--json", "--record", str(folder / "run")]
        case.run = observed.command("run", asked, ())
    case.seconds = (clock.now() - began) / NS_PER_S
    return case


def _advised(reason: str, plate: dict[str, Any], options: list[str]) -> bool:
    """Do what a message advises, if that is in the power of who stands beside the drive; False: it is not."""
    before = len(options), len(plate)
    if "counts_per_revolution" in reason:
        plate.setdefault("encoder", {"counts_per_revolution": COUNTS})
    for option in ("--trust-nameplate", "--unwatched"):
        if option in reason and option not in options:
            options.append(option)
    return (len(options), len(plate)) != before


def mode_to_run(eds: Ended) -> str:
    """The first mode that ``hil eds`` gives for ``hil run``; empty if it gives none."""
    return next((each["run"] for each in eds.figures.get("usable_modes", ()) if each["run"]), "")


def _scale(out: Path) -> str:
    """Units and motor that a commissioning found, for a bench by hand."""
    motor, drive = out / "motor.toml", out / "drive.toml"
    commissioned = f'commissioned = "{drive}"' if drive.exists() else ""
    return f'motor = "{motor if motor.exists() else _MOTOR}"\n{commissioned}'


_PID: Final = """kind = "pid"
proportional_nm_s_rad = 0.12
integral_nm_rad = 2.0"""
_STREAM: Final = 'kind = "stream"'
"""For a drive that closes the loop of speed or position by itself."""


def _own_bench(folder: Path, sheet: Path, hub: str, mode: str, scale: str) -> Path:
    """A bench as somebody writes it by hand where commissioning left none.

    Cycles that the host is too late for are the machine's, and no verdict on the drive.
    """
    tables = f"""[bench]
name = "by-hand"
duration_s = 1.0

[bus]
spec = "hub:{hub}"

[loop]
period_us = {PERIOD_US}

[host]
heartbeat_timeout_ms = {HEARTBEAT_TIMEOUT_MS}

[drive.axis1]
node = {NODE}
heartbeat_timeout_ms = {HEARTBEAT_TIMEOUT_MS}
eds = "{sheet}"
{scale}
mode = "{mode or "cst"}"

[drive.axis1.limits]
speed_max_rpm = 500.0
torque_max_nm = 1.0

[drive.axis1.controller]
{_PID if mode in ("", "cst") else _STREAM}

[[reference.axis1]]
kind = "ramp"
at_s = 0.2
{"position_rad = 2.0" if mode in ("csp", "ip") else "speed_rpm = 100.0"}
over_s = 0.3

[verdict]
missed_percent_max = 50.0
"""
    path = folder / "by_hand.toml"
    path.write_text(tables)
    return path


class _Observed:
    """The drive before and after each command, and the frames in between."""

    def __init__(self, case: Case, witness: Witness, folder: Path) -> None:
        self._case, self._witness, self._folder = case, witness, folder

    def command(self, name: str, arguments: Sequence[str], options: tuple[str, ...]) -> Ended:
        """Run it, note all that it did to the drive, and what it left."""
        case, stem = self._case, self._folder / f"{name}{len(self._case.commissions)}"
        before = self._witness.readings(case.variables)
        case.held = case.held or before
        with _started(arguments, stem) as child:
            frames = list(self._witness.frames_while(_going(child)))
        _write_log(stem.with_suffix(".log"), frames)
        case.frames += len(frames)
        listener = NodeListener(NODE, _pdo_parameters(before))
        case.accesses.setdefault(name, []).extend(listener.accesses(frames))
        case.unexplained |= listener.unexplained
        self._look(name, before)
        late = lateness(frames, NODE, pauses=name != "run")
        return replace(_end_of(options, child.returncode, stem), late=late)

    def _look(self, name: str, before: dict[Key, bytes]) -> None:
        case, after = self._case, self._witness.readings(self._case.variables)
        for key, value in before.items() if name == "commission" else ():  # a run leaves the drive set up
            if case.variables[key].writable and key not in _NO_SETTINGS and after.get(key) != value:
                now = after[key].hex() if key in after else "not readable"
                case.changed.append(f"{name}: {key[0]:04X}h:{key[1]:02X} {value.hex()} -> {now}")
        word = after.get((0x6041, 0))
        if word is not None and word[0] & 0x4F not in _NOT_ENABLED and word[0] & 0x6F not in _NOT_ENABLED:
            case.left.append(f"{name}: left with statusword {word[::-1].hex()}h")
        places = [after.get((0x6064, 0)), self._witness.read(0x6064, 0)]
        if None not in places:
            first, second = (int.from_bytes(each or b"", "little", signed=True) for each in places)
            if abs(second - first) > 2:
                case.left.append(f"{name}: left turning, 6064h {first} -> {second}")


_NO_SETTINGS: Final = frozenset({(0x6040, 0), (0x1003, 0), (0x1013, 0)})
"""Writable, and none: the controlword, the count of errors that were, and a clock."""


def _pdo_parameters(held: dict[Key, bytes]) -> dict[Key, bytes]:
    return {key: value for key, value in held.items() if 0x1400 <= key[0] < 0x1C00}


def _write_log(path: Path, frames: list[Frame]) -> None:
    """A log as can-utils' candump writes it."""
    path.write_text(
        "".join(f"({each.at_s:.6f}) hub {each.cob_id:03X}#{each.data.hex().upper()}\n" for each in frames)
    )


# ---- processes ------------------------------------------------------------------------------------------


def _going(child: subprocess.Popen[bytes]) -> Iterator[bool]:
    """True until the child has ended, or has been given up."""
    clock = MonotonicClock()
    until = clock.now() + round(_COMMAND_S * NS_PER_S)
    while child.poll() is None:
        if clock.now() > until:
            child.kill()
        yield True
    yield False


@contextmanager
def _started(arguments: Sequence[str], stem: Path) -> Iterator[subprocess.Popen[bytes]]:
    with stem.with_suffix(".json").open("wb") as out, stem.with_suffix(".txt").open("wb") as told:
        child = subprocess.Popen(
            [sys.executable, "-m", "servobench.hil.cli", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=told,
        )
        try:
            yield child
        finally:
            if child.poll() is None:
                child.kill()
            child.wait()


def _ended(arguments: Sequence[str], stem: Path) -> Ended:
    with _started(arguments, stem) as child:
        child.wait(_START_S)
    return _end_of((), child.returncode, stem)


def _end_of(options: tuple[str, ...], status: int, stem: Path) -> Ended:
    text = stem.with_suffix(".json").read_text()
    said = stem.with_suffix(".txt").read_text(errors="replace")
    return Ended(options, status, json.loads(text) if text.strip() else {}, said)


@contextmanager
def _simulated(arguments: Sequence[str], folder: Path) -> Iterator[None]:
    said, clock = folder / "simulate.txt", MonotonicClock()
    until = clock.now() + round(_START_S * NS_PER_S)
    with said.open("wb") as told:
        drive = subprocess.Popen(
            [sys.executable, "-m", "servobench.hil.cli", "simulate", *arguments],
            stdout=subprocess.DEVNULL,
            stderr=told,
        )
        try:
            while "Ctrl-C ends it" not in said.read_text():
                if drive.poll() is not None or clock.now() > until:
                    raise RuntimeError(f"hil simulate does not begin: {said.read_text()}")
                clock.sleep_until(Instant(clock.now() + NS_PER_S // 20))
            yield
        finally:
            drive.send_signal(signal.SIGINT)
            drive.wait(_START_S)
