"""One rehearsal through the command line, with the simulated shaft as witness of what moved."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from typer.testing import CliRunner

from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.cia402.profile import State
from servobench.hil.cli import app
from servobench.hil.commissioning.commission import all_steps
from servobench.hil.commissioning.rehearsal import rehearsed_drive
from servobench.hil.configuration.bench_file import load_faults
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.execution.world import WorldPlan
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.rehearsals.made_sheet import MadeSheet
from tests.rehearsals.traits import TRAITS

FAULTS_FILE = "faults.toml"
"""Beside a made-up sheet."""
JUDGING = frozenset({"bus", "identity", "units"})
"""Steps in which a drive is refused for what it is; the next one finds out which settings it takes."""
AT_REST_RAD_S = 0.1
MOVED_COUNTS = 50
"""Of 65536 on a turn."""


class Rehearsal(NamedTuple):
    """What came of one."""

    exit_code: int
    reason: str
    """Of the error that ended it; empty if nothing did."""
    ended_in: str
    """The step that it ended in; empty if it went through all."""
    not_done: dict[str, str]
    """Steps that failed or were left out, with the reason."""
    faults: list[str]
    moved: bool
    """The shaft itself stands elsewhere, or moves."""
    stands: bool
    enabled: bool
    restored: bool
    mode: str
    """In which it was set up, as a title; empty if it was not."""

    def row(self) -> str:
        """For a table."""
        if self.ended_in:
            return f"ends in {self.ended_in}{'' if not self.moved else ' AFTER MOTION'}: {self.reason}"
        left = "; ".join(f"{step}: {reason}" for step, reason in self.not_done.items())
        found = f" FOUND {'; '.join(self.faults)}." if self.faults else ""
        return f"commissioned{', but ' + left if left else ''}.{found}"

    def is_safe(self) -> bool:
        """At rest, disabled, and put back."""
        return self.stands and not self.enabled and self.restored


def made_sheet(names: Iterable[str], folder: Path) -> Path:
    """The file of a drive with these traits."""
    sheet = MadeSheet()
    for name in names:
        TRAITS[name].change(sheet)
    path = folder / "made.eds"
    path.write_text(sheet.text())
    if faults := {kind: tables for name in names for kind, tables in TRAITS[name].faults.items()}:
        (folder / FAULTS_FILE).write_text(toml_text(faults))
    return path


def fault_options(folder: Path) -> list[str]:
    """For ``hil simulate``: the plan of what is odd at the drive alone, if there is one."""
    plan = folder / FAULTS_FILE
    return ["--faults", str(plan)] if plan.exists() else []


def contradictions(sheet: Path, result: Rehearsal) -> list[str]:
    """Where hil eds says another thing of the sheet than hil commission did with its drive."""
    judged = json.loads(CliRunner().invoke(app, ["eds", str(sheet), "--json"]).stdout)
    refused = result.ended_in in JUDGING
    commissionable = [each["mode"] for each in judged["usable_modes"] if each["commission"]]
    wrong = []
    if refused and judged["serves"] and not judged["conditions"]:
        wrong.append(f"hil eds: it can serve; hil commission: {result.reason}")
    if not refused and (not judged["serves"] or (judged["conditions"] and result.ended_in != "setup")):
        wrong.append(f"hil commission did it; hil eds: {judged['obstacles'] or judged['conditions']}")
    if result.mode and result.mode not in commissionable:
        wrong.append(f"commissioned in {result.mode}; hil eds: {', '.join(commissionable)}")
    return wrong


def ran(folder: Path) -> str:
    """What ``hil run`` says of the bench that a commissioning left; empty if it passes or there is none."""
    bench = folder / "out" / "bench.toml"
    if not bench.exists():
        return ""
    if (plan := folder / FAULTS_FILE).exists():
        bench = bench.with_stem("odd")
        bench.write_text(f'{bench.with_stem("bench").read_text()}\n[faults]\nplan = "{plan}"\n')
    done = CliRunner().invoke(app, ["run", str(bench), "--no-record", "--json"])
    if done.exit_code == 0 or went_on(json.loads(done.stdout or "{}")):
        return ""
    return f"hil run leaves with {done.exit_code}: {done.stderr.splitlines()[-1:]}"


def went_on(figures: Mapping[str, Any]) -> bool:
    """A run to its end by a drive that tells errors of its own: it cannot have passed."""
    verdict = figures.get("verdict", {})
    return bool(verdict.get("completed")) and " EMCY " in verdict.get("reason", "")


def rehearsed(
    sheet: Path,
    folder: Path,
    options: Sequence[str] = (),
    last_step: str | None = None,
    change: Callable[[SimulatedServo], None] = lambda _servo: None,
) -> Rehearsal:
    """``hil commission --bus simulated --rehearse-eds SHEET``; ``last_step``: no step behind that one.
    ``change``: what is set in the drive before it is on the bus."""
    made: list[SimulatedServo] = []
    began: list[float] = []

    def kept(*given: Any) -> Any:
        servo, plate = rehearsed_drive(*given)
        change(servo)
        made.append(servo)
        began.append(servo.drive.firmware.inner.count)
        return servo, plate

    names = [step.name for step in all_steps()]
    count = len(names) if last_step is None else names.index(last_step) + 1
    few: Callable[[], Any] = lambda: all_steps()[:count]  # noqa: E731
    asked = [
        "commission",
        "--bus",
        "simulated",
        "--node",
        "1",
        "--rehearse-eds",
        str(sheet),
        "--yes",
        "--json",
    ]
    out = folder / "out"
    plan = folder / FAULTS_FILE
    faults = load_faults(plan, NamedBy("faults", "", str(plan))) if plan.exists() else None
    with (
        mock.patch("servobench.hil.commissioning.commission.WorldPlan", partial(WorldPlan, faults=faults)),
        mock.patch("servobench.hil.commissioning.commission.rehearsed_drive", kept),
        mock.patch("servobench.hil.commissioning.commission.all_steps", few),
    ):
        done = CliRunner().invoke(app, [*asked, "--out", str(out), *options])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    (servo,) = made
    if not done.stdout:  # nothing but a drive that cannot be put back ends the command without figures
        figures: dict[str, Any] = {"error": done.stderr.splitlines()[-1], "steps": [], "restored": False}
    else:
        figures = json.loads(done.stdout)
    steps = figures["steps"]
    inner = servo.drive.firmware.inner
    return Rehearsal(
        exit_code=done.exit_code,
        reason=figures["error"] or "",
        ended_in=(steps[-1]["name"] if steps else "putting back") if figures["error"] else "",
        not_done={step["name"]: step["reason"] for step in steps if step["verdict"] != "done"},
        faults=[fault for step in steps for fault in step["faults"]],
        moved=abs(inner.count - began[0]) > MOVED_COUNTS,
        stands=abs(inner.speed_measured_rad_s) < AT_REST_RAD_S,
        enabled=servo.drive.power.state is State.OPERATION_ENABLED,
        restored=figures["restored"] is not False,
        mode=next((step["figures"].get("mode", "") for step in steps if step["name"] == "setup"), "").replace(
            "_", " "
        ),
    )
