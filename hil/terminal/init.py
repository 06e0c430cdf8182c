"""``hil init``: a first bench with motor, controller and test, in a folder of one's own."""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.drivers.written_file import writing
from servobench.hil.machine.examples import examples_folder
from servobench.hil.terminal.options import flag
from servobench.hil.terminal.output import say_written

FIRST = "first"
"""The example that is written."""


def init(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Where to; made if it is not there.")
    ] = Path(),
    examples: Annotated[bool, flag("--examples", "Every example instead, in DIR/examples.")] = False,
) -> None:
    """Write a first bench: bench.toml, motor.toml, controller.py and test_controller.py.

    A file that is there already is never written over.
    """
    source = examples_folder() if examples else examples_folder() / FIRST
    target = folder / "examples" if examples else folder
    files = sorted(
        path.relative_to(source) for path in source.rglob("*")
        if path.is_file() and not {"__pycache__", "runs"} & set(path.parts)
    )  # fmt: skip
    for name in files:
        if (target / name).exists():
            raise BadInput("DIR", "", str(target / name), "a folder without this file")
    with writing("DIR", target):
        for name in files:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / name, target / name)
    say_written(target)
    if not examples:
        typer.echo(f"Next, in {target.resolve()}:" if folder != Path() else "Next:")
        typer.echo("  hil run bench.toml    the closed loop in simulated time, recorded, with its verdict")
        typer.echo("  pytest                the controller under lost readings and a silent drive")
