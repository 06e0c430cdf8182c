"""What docs/write-your-own.md writes, put into a copy of the program as it stands there, and used."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from servobench.hil.rows.records_file import read_table
from tests.scenario.processes import quiet_environment

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = (ROOT / "docs" / "write-your-own.md").read_text(encoding="utf-8")
ROOMS: Final = ("design", "drivers", "hil", "virtual_bus")
LEFT_OUT: Final = shutil.ignore_patterns("*.cpython-*.so", "compiled.json")
RPM: Final = np.pi / 30.0
TABLE: Final = {
    title: (place.strip("`"), lines)
    for title, place, lines in re.findall(r"^\| \[.*?\]\(#(.*?)\) \| (.*?) \| (.*?) \|$", PAGE, re.MULTILINE)
}

BENCH: Final = """
[bench]
name = "own"
duration_s = 0.4

[drive.axis1]
node = 1
motor = "{motor}"

[drive.axis1.limits]
speed_max_rpm = 4000.0
torque_max_nm = 3.0

[drive.axis1.compensator]
{compensator}

[drive.axis1.controller]
{controller}

[[reference.axis1]]
at_s = 0.0
kind = "step"
speed_rpm = 300.0
"""


def section(title: str) -> str:
    """The text below a heading of the page."""
    begin = PAGE.index(f"\n## {title}\n")
    return PAGE[begin : PAGE.find("\n## ", begin + 1) % len(PAGE)]


COMMANDS: Final = """
import json, sys
from typer.testing import CliRunner
from servobench.hil.cli import app
done = [CliRunner().invoke(app, command) for command in json.loads(sys.argv[1])]
print(json.dumps([[each.exit_code, each.output] for each in done]))
"""


class Copy:
    """The program with what some sections of the page write."""

    def __init__(self, folder: Path, *titles: str) -> None:
        self.folder = folder
        self.changed: list[str] = []
        for room in ROOMS:
            shutil.copytree(ROOT / room, folder / room, ignore=LEFT_OUT)
        shutil.copytree(ROOT / "servobench", folder / "servobench", symlinks=True)
        unviewed = "import sys\nsys.modules['rerun'] = None\n"  # to write run.rrd takes half of a run's time
        (folder / "sitecustomize.py").write_text(unviewed)
        for text in map(section, titles):
            for name, code in re.findall(r"As\s`([^`]*)`:\n\n```\w+\n(.*?)```", text, re.DOTALL):
                assert not (folder / name).exists()
                (folder / name).write_text(code, encoding="utf-8")
                self.changed.append(name)
            for name, lines in re.findall(r"In `([^`]*)`:\n\n```diff\n(.*?)```", text, re.DOTALL):
                self._register(folder / name, lines.splitlines())
                self.changed.append(name)

    def _register(self, path: Path, difference: Sequence[str]) -> None:
        lines, at = path.read_text(encoding="utf-8").splitlines(), 0
        for line in difference:
            if line[0] == "+":
                lines.insert(at, line[1:])
                at += 1
                continue
            assert lines.count(line[1:]) == 1, line
            at = lines.index(line[1:]) + (line[0] == " ")
            if line[0] == "-":
                del lines[at]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def python(self, *arguments: str) -> str:
        """What Python prints in the copy."""
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=self.folder,
            env={**quiet_environment(), "PYTHONPATH": str(self.folder)},
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    def hil(self, *commands: Sequence[str]) -> list[tuple[int, str]]:
        """The status of each and what it prints in the copy, which is imported once for all."""
        told = json.loads(self.python("-c", COMMANDS, json.dumps(commands)).splitlines()[-1])
        return [(status, text) for status, text in told]

    def bench(self, controller: str, compensator: str = 'kind = "arrival"', name: str = "bench.toml") -> str:
        """A step of 300 r/min without a load."""
        motor = ROOT / "examples" / "motors" / "ling2012.toml"
        path = self.folder / name
        path.write_text(BENCH.format(motor=motor, controller=controller, compensator=compensator))
        return str(path)


def recorded(folder: Path) -> dict[str, "np.ndarray[Any, Any]"]:
    """The columns of a run."""
    table = read_table(folder / "records.arrow")
    return {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}


def copy(tmp_path: Path, title: str) -> Copy:
    """The copy, of which one file is new and at most one is a register, as the page's table says."""
    made = Copy(tmp_path / "copy", title)
    home, register = TABLE[title.lower().replace(" ", "-")]
    new, *registers = made.changed
    if home != "the same":
        assert Path(new).match(home if "*" in home else f"{home}*")
    assert len(registers) == (0 if register.startswith("none") else 1)
    assert all(name.rpartition("/")[2] in register for name in registers)
    return made


def test_the_page_writes_all_kinds() -> None:
    titles = [title.lower().replace(" ", "-") for title in re.findall(r"^## (.*)$", PAGE, re.MULTILINE)]
    assert titles == list(TABLE)


def test_a_controller(tmp_path: Path) -> None:
    """Witness: what a relay is. Its torque changes sign in the first cycle beyond 20 r/min, never else."""
    made = copy(tmp_path, "A controller")
    bench = made.bench('kind = "relay"\ntorque_nm = 0.8\nhysteresis_rpm = 20.0')
    below = made.bench('kind = "relay"\ntorque_nm = -1.0', name="below.toml")
    unknown = made.bench('kind = "rely"', name="unknown.toml")
    ran, refused, another = made.hil(
        ["run", bench, "--record", str(tmp_path / "run")],
        ["run", below, "--no-record"],
        ["run", unknown, "--no-record"],
    )
    assert ran[0] == 0, ran
    rows = recorded(tmp_path / "run")
    assert set(np.round(rows["command_torque_nm"], 6)) == {-0.8, 0.8}
    side = 1.0
    error = rows["reference_rad_s"] - rows["estimate_velocity_rad_s"]
    for torque_nm, of_speed in zip(rows["command_torque_nm"], error, strict=True):
        side = np.sign(of_speed) if abs(of_speed) > 20.0 * RPM else side
        assert np.sign(torque_nm) == side
    assert np.count_nonzero(np.diff(np.sign(rows["command_torque_nm"]))) > 8, "it oscillates"
    assert refused[0] == another[0] == 2
    assert "torque_nm" in refused[1]
    assert "hysteresis_rpm" in refused[1]
    assert "relay" in another[1]


def test_a_compensator(tmp_path: Path) -> None:
    """Witness: the speed that the drive tells of the instant for which the state was meant."""
    made = copy(tmp_path, "A compensator")
    controller = 'kind = "pid"\nproportional_nm_s_rad = 0.05'
    apart = {}
    kinds = ("arrival", "dead_reckoning")
    benches = [made.bench(controller, f'kind = "{kind}"', f"{kind}.toml") for kind in kinds]
    ran = made.hil(*(["run", bench, "--record", bench.removesuffix(".toml")] for bench in benches))
    assert [status for status, _ in ran] == [0, 0], ran
    for kind in kinds:
        rows = recorded(made.folder / kind)
        wanted = np.interp(rows["command_effective_at"], rows["sampled_at"], rows["velocity_rad_s"])
        early = slice(2, 60)  # while it gains speed
        apart[kind] = np.sqrt(np.mean((rows["estimate_velocity_rad_s"] - wanted)[early] ** 2))
    assert apart["dead_reckoning"] < 0.5 * apart["arrival"]


FAULT: Final = """
import json
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.bus.judge import LOST
from servobench.virtual_bus.faults.fault_injector import FaultInjector
from servobench.virtual_bus.faults.fault_log import FaultLog, entry_line, read_line
from servobench.virtual_bus.faults.fault_plan import load_fault_plan, read_fault_plan
from servobench.virtual_bus.faults.fates import RecordedFaults, ReplayedFates

AT = (0, 400, 900, 2_000, 2_100, 9_000)

def lost(fates):
    fates.start(Instant(0))
    return [at for at in AT if fates.hold(1, 0x181, Instant(at * 1000), False) == LOST]

log, again = FaultLog(), FaultLog()
plan = load_fault_plan({"wake_up_loss": [{"idle_s": 0.001, "until_s": 0.005}]}, "plan.toml")
injector = FaultInjector(plan, 1, log=log)
struck = lost(injector)
lines = [entry_line(entry) for entry in log.entries()]
recorded = RecordedFaults(tuple(read_line(line, "f", 1) for line in lines))
errors = read_fault_plan({"wake_up_loss": [{"idle_ms": 1}, {"idle_s": 0}]}, "plan.toml")[1]
print(json.dumps({
    "struck": struck,
    "replayed": lost(ReplayedFates(recorded, again)),
    "written": load_fault_plan(plan.as_tables(), "written") == plan,
    "counts": injector.counts()["drive_to_host"],
    "line": lines[0],
    "errors": [str(error) for error in errors],
}))
"""


def test_a_fault(tmp_path: Path) -> None:
    """From its table to its replay."""
    seen = json.loads(copy(tmp_path, "A fault").python("-c", FAULT))
    assert seen["struck"] == seen["replayed"] == [0, 2_000], "at 9 ms its window is over"
    assert seen["written"]
    assert seen["counts"] == {"frames": 6, "wake_up_loss": 2, "delayed": 0}
    assert seen["line"] == '{"kind":"wake_up_loss","at_ns":0,"direction":"drive_to_host","can_id":385,"n":0}'
    unknown, zero = seen["errors"]
    assert "wake_up_loss[0].idle_ms: found 1, expected idle_s (the unit is part of the key)" in unknown
    assert "wake_up_loss[1].idle_s: found 0, expected a time > 0" in zero


def test_a_step_of_commissioning(tmp_path: Path) -> None:
    """Witness: the voltage that the rehearsed machine's nameplate tells."""
    made = copy(tmp_path, "A step of commissioning")
    command = ["commission", "--bus", "simulated", "--node", "1", "--rehearse", "3", "--dry-run", "--yes"]
    ((_, text),) = made.hil([*command, "--json", "--out", str(tmp_path / "out")])
    told = text.splitlines()
    figures = json.loads(next(line for line in told if line.startswith("{")))
    step = figures["steps"][2]
    assert (step["name"], step["verdict"]) == ("dc_link", "done")
    plate_v = figures["header"]["nameplate"]["rating"]["dc_bus_voltage_v"]
    assert step["figures"]["dc_link_v"] == pytest.approx(plate_v, rel=1e-3)
    assert f"    {plate_v:.1f} V, ripple 0.00 V" in told, "it is told as the others are"


FAMILY: Final = """
from servobench.drivers.vendors.families import codes_of, motor_objects_for, quirks_for
(known,) = (family for family in codes_of(0x29C, "DRIVE 7") if family.name == "example.toml")
print([known.text(code) for code in (0x7380, 0xFF0F, 0xFF10)])
print([quirk.velocity_rpm for name, quirk in quirks_for(0x29C, 1, "Drive 7") if name == "example.toml"])
print([name for name, _ in motor_objects_for(0x29C, 1, "Drive 7")])
print([name for name, _ in motor_objects_for(0x29C, 1, "Other") if name == "example.toml"])
"""


def test_a_family_of_drives(tmp_path: Path) -> None:
    told = copy(tmp_path, "A family of drives").python("-c", FAMILY).splitlines()
    assert told[:2] == ["['encoder: no signal', 'safety module', None]", "[0.1]"]
    assert "example.toml" in told[2]
    assert told[3] == "[]"


def test_a_command(tmp_path: Path) -> None:
    made = copy(tmp_path, "A command")
    bench = made.bench('kind = "pid"\nproportional_nm_s_rad = 0.05')
    one, again, other = (str(tmp_path / name) for name in ("one", "again", "other"))
    made.hil(*(["run", bench, "--seed", seed, "--record", to] for to, seed in ((one, "1"), (other, "2"))))
    shutil.copytree(one, again)
    same, differing, none = made.hil(
        ["digest", one, again], ["digest", one, other, "--json"], ["digest", str(tmp_path)]
    )
    told = json.loads((tmp_path / "one" / "summary.json").read_text())["digest"]
    assert same[0] == 0
    assert [line.split()[0] for line in same[1].splitlines()] == [told] * 2
    digests = json.loads(differing[1])["digests"]
    assert differing[0] == 1
    assert digests[one] == told != digests[other]
    assert none[0] == 2
    assert "the folder of a recording" in none[1]


def test_what_the_page_writes_passes_the_checks(tmp_path: Path) -> None:
    """All of it in one copy: what one section writes stands in no other's way."""
    titles = "A controller", "A compensator", "A fault", "A step of commissioning", "A command"
    made = Copy(tmp_path / "copy", *titles)
    shutil.copy(ROOT / "pyproject.toml", made.folder)
    python = sorted(set(made.changed))
    made.python("-m", "ruff", "check", "--no-cache", *python)
    made.python("-m", "ruff", "format", "--no-cache", "--check", *python)
    floors = made.python("-c", "from importlinter.cli import lint_imports_command as lint; lint()")
    assert "0 broken" in floors
