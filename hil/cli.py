"""The command line: ``hil run``, ``hil simulate``, ``hil doctor``.

What a command needs is imported inside it, so that ``hil --help`` answers at once.
"""

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import BadInput
from hil.machine.compiled import require_fresh
from hil.terminal.exit_status import ExitStatus, complain, reported_errors
from hil.terminal.groups import design, reproduce

app = typer.Typer(
    name="hil",
    help="Hardware-in-the-loop bench for networked PMSM servo drives over CANopen.",
    add_completion=False,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
)
for group in (reproduce, design):
    app.add_typer(group)


class TimeBase(StrEnum):
    """Whose time the loop runs in."""

    SIMULATED = "simulated"
    REAL = "real"


BusOption = Annotated[
    str | None,
    typer.Option(
        "--bus",
        metavar="SPEC",
        help="simulated, hub:NAME, socketcan:vcan0, or INTERFACE:CHANNEL of python-can.",
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON object on stdout, all else on stderr.")
]
SeedOption = Annotated[
    int | None, typer.Option("--seed", min=0, max=2**63 - 1, help="Seed of every random stream.")
]


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"servobench {version('servobench')}")
        raise typer.Exit


@app.callback()
def _hil(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Hardware-in-the-loop bench for networked PMSM servo drives over CANopen."""


@app.command()
def run(
    bench: Annotated[Path, typer.Argument(metavar="BENCH.toml", help="The bench file.")],
    bus: BusOption = None,
    time: Annotated[
        TimeBase | None, typer.Option("--time", help="Time base; the bus decides if absent.")
    ] = None,
    seed: SeedOption = None,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="DIR", help="Folder of the recording, new or empty.")
    ] = None,
    replay_faults: Annotated[
        Path | None,
        typer.Option(
            "--replay-faults",
            metavar="FILE",
            help="faults.jsonl of a run; instead of the bench's own faults.",
        ),
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show the run in the Rerun viewer while it goes on.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Run a bench: close the loop, record it, and hold the result against the bench file's limits.

    Exit status: 0 passed, 1 not passed, 2 bad input, 3 bus or drive fault.
    """
    with reported_errors():
        from hil.configuration.bench_file import load_bench, load_faults
        from hil.configuration.config_files import NamedBy

        config = load_bench(bench)
        if replay_faults is not None:
            named_by = NamedBy("--replay-faults", "", str(replay_faults))
            config = config.with_faults(load_faults(replay_faults, named_by))

        from hil.bench import run_bench
        from hil.terminal.progress import TerminalProgress

        progress = TerminalProgress(sys.stderr, config.bench.duration_s)
        try:
            outcome = run_bench(
                config,
                bus_spec=bus,
                time=time.value if time else None,
                seed=seed,
                record=record,
                view=view,
                progress=progress,
            )
        finally:
            progress.clear()
        if as_json:
            typer.echo(json.dumps(outcome.summary, allow_nan=False))
        else:
            from hil.terminal.report import print_run

            print_run(config, outcome.summary, outcome.recording, bus_spec=bus)
        raise typer.Exit(ExitStatus.PASSED if outcome.passed else ExitStatus.FAILED)


@app.command()
def simulate(
    bus: Annotated[
        str, typer.Option("--bus", metavar="SPEC", help="A real-time bus: hub:NAME, socketcan:vcan0, ...")
    ],
    node: Annotated[
        list[str],
        typer.Option(
            "--node",
            metavar="N...",
            help="Node ids: 1, or 1,2, or 1-3, or unconfigured (LSS gives one); may be repeated.",
        ),
    ],
    more_nodes: Annotated[list[str] | None, typer.Argument(metavar="[N...]", hidden=True)] = None,
    motor: Annotated[
        Path | None, typer.Option("--motor", metavar="MOTOR.toml", help="Motor file; [Ling2012]'s if absent.")
    ] = None,
    faults: Annotated[
        Path | None, typer.Option("--faults", metavar="FAULTS.toml", help="Fault plan, at the drive's side.")
    ] = None,
    eds: Annotated[
        Path | None,
        typer.Option("--eds", metavar="FILE", help="EDS or DCF of the device to rehearse: its dictionary."),
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option("--store", metavar="FILE", help="Where 1010h and LSS store; made when first stored to."),
    ] = None,
    background: Annotated[
        Path | None,
        typer.Option("--background", metavar="FILE", help="Other nodes' traffic: tables [[background]]."),
    ] = None,
    bitrate: Annotated[
        int, typer.Option("--bitrate", min=10_000, help="Bit rate of the bus, bit/s.")
    ] = 1_000_000,
    seed: SeedOption = None,
) -> None:
    """Simulated drives as a process of their own on a real-time bus, until Ctrl-C."""
    with reported_errors():
        from hil.configuration.background import load_background
        from hil.configuration.bench_file import load_faults
        from hil.configuration.config_files import NamedBy
        from hil.configuration.motor_file import LING2012, load_motor
        from hil.terminal.node_list import node_ids

        nodes = node_ids([*node, *(more_nodes or [])])
        motor_file = load_motor(motor, NamedBy("--motor", "", str(motor))) if motor else LING2012
        plan = load_faults(faults, NamedBy("--faults", "", str(faults))).plan if faults else None
        named_by = NamedBy("--background", "", str(background))
        others = load_background(background, named_by) if background else ()

        from hil.device_files import DeviceFiles
        from hil.simulated_drives import simulate as simulate_drives

        simulate_drives(
            bus_spec=bus,
            nodes=nodes,
            motor=motor_file.parameters,
            faults=plan,
            bitrate_bit_s=bitrate,
            seed=seed or 0,
            announce=lambda text: print(text, file=sys.stderr, flush=True),
            files=DeviceFiles(eds, store),
            background=others,
        )


@app.command()
def doctor(as_json: JsonOption = False) -> None:
    """Say what this machine can do, and the exact command that mends each lack."""
    with reported_errors():
        from hil.machine.doctor import run_checks

        checks = run_checks()
        if as_json:
            from dataclasses import asdict

            typer.echo(json.dumps([asdict(check) for check in checks]))
        else:
            from hil.machine.doctor import print_checks

            print_checks(checks)


def main() -> None:
    """Entry point of the command ``hil``."""
    try:
        require_fresh()
    except BadInput as error:
        sys.exit(complain(error))
    app()


if __name__ == "__main__":
    main()
