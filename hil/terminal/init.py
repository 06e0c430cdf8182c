"""``hil init``: a first bench with motor, controller and test, in your own folder."""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.drivers.written_file import writing
from servobench.hil.machine.extras import examples_folder, is_installed
from servobench.hil.terminal.options import flag
from servobench.hil.terminal.output import say, say_written

FIRST = "first"
"""The example to write."""


def init(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder to write to; created if missing.")
    ] = Path(),
    examples: Annotated[bool, flag("--examples", "Write every example instead, in DIR/examples.")] = False,
) -> None:
    """Write a first bench: bench.toml, motor.toml, controller.py, test_controller.py and sweep.toml.

    An existing file is never overwritten.

    Examples:
      hil init
      hil init --examples
    """
    source = examples_folder() if examples else examples_folder() / FIRST
    target = folder / "examples" if examples else folder
    files = sorted(
        path.relative_to(source) for path in source.rglob("*")
        if path.is_file() and not {"__pycache__", "runs"} & set(path.parts)
    )  # fmt: skip
    for name in files:
        if (target / name).exists():
            raise BadInput(
                "DIR", "", str(target / name), "a folder without this file", "no file is overwritten"
            )
    with writing("DIR", target):
        for name in files:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / name, target / name)
    say_written(target)
    if not examples:
        typer.echo(f"Next, in {target.resolve()}:" if folder != Path() else "Next:")
        typer.echo("  hil run bench.toml        close the loop in simulated time, record and judge it")
        typer.echo("  pytest                    test the controller with lost readings and a silent drive")
        typer.echo("  hil campaign sweep.toml   run the bench with losses and a tolerance of the inertia")
        if not is_installed("scipy"):
            say("hil: note: hil campaign needs an extra: pip install 'servobench[campaign]'")
