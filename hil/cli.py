"""The command line: ``hil run``, ``hil simulate``, ``hil doctor``.

Commands import what they need when called, so that ``hil --help`` answers at once.
"""

from servobench.hil.terminal.options import JsonOption, SeedOption, bus_option, flag, valued
from servobench.hil.terminal.start_conditions import refuse_to_begin

refuse_to_begin()  # before the first import from a package that a folder of the user's could hide

import os

# before numpy is imported: the matrices are small here, and more threads take longer for them than one
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from servobench.drivers.compiled import notice, use_fresh
from servobench.drivers.errors import BadInput
from servobench.hil.machine.extras import MissingExtra, is_installed
from servobench.hil.machine.parent_process import messages, tell_parent
from servobench.hil.terminal import analyse_losses, analyse_peaks, analyse_speed, design_speed
from servobench.hil.terminal.adapter import adapter
from servobench.hil.terminal.brake import brake
from servobench.hil.terminal.campaign import campaign
from servobench.hil.terminal.commands import (
    PanelGroup,
    PlainGroup,
    add_commands,
    as_command,
    leave_only,
    reported_errors,
)
from servobench.hil.terminal.commission import commission, rehearse, restore
from servobench.hil.terminal.compare import compare
from servobench.hil.terminal.design_current import current
from servobench.hil.terminal.design_hinf import hinf
from servobench.hil.terminal.design_pid import pid
from servobench.hil.terminal.docs import docs
from servobench.hil.terminal.eds import eds
from servobench.hil.terminal.export import export
from servobench.hil.terminal.fault import fault
from servobench.hil.terminal.fit import fit
from servobench.hil.terminal.init import init
from servobench.hil.terminal.io import io
from servobench.hil.terminal.jog import homing, jog
from servobench.hil.terminal.measure import measure
from servobench.hil.terminal.motor import motor
from servobench.hil.terminal.output import say
from servobench.hil.terminal.params import clone, diff, load, save
from servobench.hil.terminal.phase import phase
from servobench.hil.terminal.picture import picture
from servobench.hil.terminal.presets import presets
from servobench.hil.terminal.recover import recover
from servobench.hil.terminal.reproduce import azaiz2007, ling2012
from servobench.hil.terminal.review import review
from servobench.hil.terminal.run_object import RunCommand, RunObject, read_back
from servobench.hil.terminal.runs import runs
from servobench.hil.terminal.scan import scan
from servobench.hil.terminal.scope import scope
from servobench.hil.terminal.simulate import simulate
from servobench.hil.terminal.stop import stop
from servobench.hil.terminal.supervision import is_supervised, supervised, unsupervised
from servobench.hil.terminal.trace import trace
from servobench.hil.terminal.tune import tune
from servobench.hil.terminal.verify import verify
from servobench.hil.terminal.view import missing_display, say_served, view
from servobench.hil.terminal.why import why

if TYPE_CHECKING:
    from servobench.hil.configuration.config import BenchConfig
    from servobench.hil.recording.run_recorder import RunRecorder
    from servobench.hil.rows.recording_plan import RecordingPlan, ServedPorts

app = typer.Typer(
    name="hil",
    cls=PanelGroup,
    help="Hardware-in-the-loop bench for networked PMSM servo drives over CANopen.",
    pretty_exceptions_enable=False,
    no_args_is_help=True,
)
reproduce = typer.Typer(
    name="reproduce", cls=PlainGroup, help="Reproduce the results of the papers.", no_args_is_help=True
)
add_commands(reproduce, azaiz2007, ling2012)

params = typer.Typer(
    name="params",
    cls=PlainGroup,
    help="Keep, compare, load and clone a drive's parameters.",
    no_args_is_help=True,
)
add_commands(params, save, load, diff, clone)

design = typer.Typer(name="design", cls=PlainGroup, help="Design a controller.", no_args_is_help=True)
add_commands(design, current, hinf, pid, design_speed.speed)

analyse = typer.Typer(
    name="analyse", cls=PlainGroup, help="Analyse a loop: exact and certified figures.", no_args_is_help=True
)
add_commands(analyse, analyse_speed.speed, analyse_losses.losses, analyse_peaks.peaks)


def _show_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"servobench {version('servobench')}")
        raise typer.Exit


@app.callback()
def _hil(
    version: Annotated[
        bool,
        typer.Option(
            "--version", metavar="", callback=_show_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Hardware-in-the-loop bench for networked PMSM servo drives over CANopen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """Options of ``hil run``."""

    bench: Annotated[Path, typer.Argument(metavar="BENCH.toml", help="The bench file.")]
    bus: Annotated[
        str | None, bus_option("simulated, hub:NAME, socketcan:vcan0, or INTERFACE:CHANNEL of python-can.")
    ] = None
    time: Annotated[
        Literal["simulated", "real"] | None, valued("--time", None, "Time base; default: by the bus.")
    ] = None
    seed: SeedOption = None
    record: Annotated[Path | None, valued("--record", "DIR", "Folder of the recording, new or empty.")] = None
    no_record: Annotated[bool, flag("--no-record", "Write no files; print figures and verdict only.")] = False
    controller: Annotated[
        list[str] | None,
        valued(
            "--controller",
            "AXIS=FILE.py:NAME",
            "Your own controller, or a controller file (AXIS=FILE.toml), in place of the bench's; "
            "repeatable.",
        ),
    ] = None
    replay_faults: Annotated[
        Path | None,
        valued("--replay-faults", "FILE", "Replay faults.arrow of a run instead of the bench's own faults."),
    ] = None
    live: Annotated[bool, flag("--view", "Show the run live in the Rerun viewer.")] = False
    served: Annotated[
        bool, flag("--serve", "Serve the run to browsers and viewers of this machine while it goes on.")
    ] = False
    network: Annotated[
        Path | None,
        valued(
            "--network",
            "NETWORK.toml",
            "A network measured earlier; refused if a controller was designed for a better one.",
        ),
    ] = None
    allow_uncertified: Annotated[
        bool,
        flag(
            "--allow-uncertified",
            "Warn instead of refusing if network or drive are outside a controller's certificate.",
        ),
    ] = False
    as_json: JsonOption = False


@app.command(cls=RunCommand, rich_help_panel="Run")
@as_command
def run(asked: RunOptions) -> None:
    """Run a bench: close the loop, record it, and judge it by the bench file's limits.

    Exit status: 0 passed, or no limits set; 1 not passed; 2 bad input; 3 bus, drive or safety; 4 not
    trustworthy, or disturbed by others; 5 not recorded; 6 cut short or not measured; 130 ended by a signal.
    In full: hil docs exit-status

    Examples:
      hil run bench.toml
      hil run bench.toml --record runs/monday
      hil run bench.toml --seed 2 --record runs/tuesday
      hil run bench.toml --bus socketcan:can0   # a real drive
    """
    run_object = RunObject(asked.as_json)
    with reported_errors(run_object.failed, "hil run"):
        shown = "--view" if asked.live else "--serve" if asked.served else ""
        if asked.no_record and (asked.record is not None or shown):
            raise BadInput("--no-record", "", True, "no --record, --view or --serve with it")
        if not asked.no_record and not is_installed("rerun"):
            lack = MissingExtra("rerun", shown or "run.rrd")
            if shown:
                raise lack
            say(f"hil: note: {lack}; all else is recorded")
        if asked.live and missing_display():
            say("hil: note: --view: no display here; the recording is kept, see hil view")
        config = _bench_to_run(asked)

        from servobench.hil.configuration.config_checks import idle_faults
        from servobench.hil.configuration.quantities import odd_values
        from servobench.hil.execution.network_guard import Certificates

        doubts = Certificates(config.as_run(asked.bus or config.bus.spec, asked.seed)).doubts()
        for note in (*odd_values(config), *idle_faults(config), *doubts):
            say(f"hil: note: {note}")

        from servobench.hil.execution.bench import run_bench
        from servobench.hil.machine.progress import TerminalProgress

        nodes = [drive.node for drive in config.drive.values()]
        tell_parent(bus=asked.bus or config.bus.spec, bitrate=config.bus.bitrate_bit_s, nodes=nodes)

        progress = TerminalProgress(messages(), config.bench.duration_s)
        try:
            summary = run_bench(
                config,
                bus_spec=asked.bus,
                time=asked.time,
                seed=asked.seed,
                record=asked.record,
                keep=not asked.no_record,
                view=asked.live,
                served=_ports() if asked.served else None,
                progress=progress,
                network=asked.network,
                allow_uncertified=asked.allow_uncertified,
                recording=_recorder,
                concluded=run_object.concluded,
            )
        finally:
            progress.clear()
        tell_parent(nodes=[])  # they were let go
        summary = read_back(summary)
        run_object.print(summary)
        if not asked.as_json:
            from servobench.hil.terminal.report import print_run

            print_run(config, summary, bus_spec=asked.bus)
        raise typer.Exit(summary.verdict.exit_status)


def _recorder(plan: "RecordingPlan") -> "RunRecorder":
    from servobench.hil.recording.recorder import Recorder, recorder_of

    recorder = recorder_of(plan)
    if plan.served is not None:
        say_served(plan.served)
    if plan.folder is not None and isinstance(recorder, Recorder):
        tell_parent(recording=str(plan.folder.absolute()), logger=recorder.logger_process_id)
    return recorder


def _ports() -> "ServedPorts":
    from servobench.hil.recording.serving import choose_ports

    return choose_ports()


def _bench_to_run(asked: RunOptions) -> "BenchConfig":
    """Load the bench file, with its parts replaced by the command line."""
    from servobench.drivers.bounded_file import NamedBy
    from servobench.hil.configuration.bench_file import load_bench, load_faults, with_controllers

    config = with_controllers(load_bench(asked.bench), asked.controller or ())
    if asked.replay_faults is None:
        return config
    named_by = NamedBy("--replay-faults", "", str(asked.replay_faults))
    return config.model_copy(update={"faults": load_faults(asked.replay_faults, named_by)})


def doctor(as_json: JsonOption = False) -> None:
    """Check what this machine can do, and print the command that cures each lack.

    Examples:
      hil doctor
    """
    from servobench.hil.machine.doctor import print_checks, run_checks

    checks = run_checks()
    if as_json:
        typer.echo(json.dumps([asdict(check) for check in checks]))
    else:
        print_checks(checks)


add_commands(app, init, simulate, presets, doctor, docs, panel="Run")
add_commands(app, scan, trace, scope, fault, stop, io, eds, adapter, panel="Inspect")
add_commands(
    app, commission, jog, homing, brake, phase, tune, measure, fit, restore, rehearse, panel="Commission"
)
add_commands(app, view, why, review, runs, compare, picture, export, recover, panel="Review")
app.add_typer(campaign, rich_help_panel="Run")
app.add_typer(params, rich_help_panel="Inspect")
for group in (design, analyse, motor, reproduce):
    app.add_typer(group, rich_help_panel="Design")
add_commands(app, verify, panel="Design")


def main() -> None:
    """Entry point of the command ``hil``."""
    note, arguments = notice(use_fresh()), sys.argv[1:]
    leave_only(app, arguments)

    def command() -> None:
        if note:
            say(f"hil: note: {note}")
        app()

    if is_supervised(arguments):
        supervised(command, arguments)
    unsupervised(command)


if __name__ == "__main__":
    main()
