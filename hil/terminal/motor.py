"""``hil motor new`` and ``hil motor show``: a motor file from a data sheet, and figures derived from it."""

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.studies.motor.figures import FIGURES, GROUPS, SheetFigure, missing, option, ways
from servobench.hil.terminal.commands import PlainGroup, add_commands
from servobench.hil.terminal.options import JsonOption, MotorArgument, flag, motor_file, valued
from servobench.hil.terminal.output import columns, put, say_written

motor = typer.Typer(
    name="motor",
    cls=PlainGroup,
    help="Make a motor file from a data sheet, or show its figures.",
    no_args_is_help=True,
)


def new(
    out: Annotated[Path, typer.Argument(metavar="MOTOR.toml", help="The file to write.")],
    name: Annotated[str, valued("--name", None, "Name of the motor; default: the file's.")] = "",
    delta: Annotated[
        bool, flag("--delta/--star", "Connection of the phases, if figures are per phase.")
    ] = False,
    resistance_at_c: Annotated[
        float,
        valued("--resistance-at-c", None, "Winding temperature on the sheet.", min=-50.0, max=250.0),
    ] = 20.0,
    winding_c: Annotated[
        float | None,
        valued(
            "--winding-c",
            None,
            "Winding temperature to simulate; default: the sheet's.",
            min=-50.0,
            max=250.0,
        ),
    ] = None,
    force: Annotated[bool, flag("--force", "Overwrite an existing file.")] = False,
    **figures: float | None,
) -> None:
    """Write a motor file from a data sheet, each figure in the sheet's own convention.

    Contradictory figures are refused, with the convention in which they would agree. On a terminal, missing
    ones are asked for.

    Examples:
      hil motor new m.toml --poles 8   # status 2: it says what is missing
    """
    from servobench.drivers.written_file import write_file
    from servobench.hil.studies.motor.sheet import SOURCE, Sheet, motor_text
    from servobench.hil.terminal.current_report import refused

    if out.exists() and not force:
        raise BadInput("MOTOR.toml", "", str(out), "a file that is not there yet", "or --force")
    values = {key: value for key, value in figures.items() if value is not None}
    if at_terminal():
        _ask(values)
    with refused(SOURCE):
        text = motor_text(Sheet(name or out.stem, values, delta, resistance_at_c, winding_c))
    write_file("MOTOR.toml", out, text)
    say_written(out)


def at_terminal() -> bool:
    """Return True if a user can be asked."""
    return sys.stdin.isatty()


def _ask(values: dict[str, float]) -> None:
    """Complete ``values`` with answers of the user at the terminal."""
    for group in missing(values):
        choices = ways(group)
        typer.echo(GROUPS[group].question)
        for number, figure in enumerate(choices, 1):
            typer.echo(f"  {number}  {figure.text}")
        chosen = 1 if len(choices) == 1 else typer.prompt("  as the sheet has it", type=int)
        if not 1 <= chosen <= len(choices):
            raise BadInput("answer", GROUPS[group].question, chosen, f"1 to {len(choices)}")
        figure = choices[chosen - 1]
        values[figure.key] = typer.prompt(f"  {figure.text}", value_proc=_reader(figure))


def _reader(figure: SheetFigure) -> Callable[[str], float]:
    def number(entered: str) -> float:
        try:
            return figure.number(entered)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error

    return number


def _with_figures() -> None:
    """Give ``new`` an option for each figure of a sheet: one table for options, questions and errors."""
    signature = inspect.signature(new)
    fixed = [item for item in signature.parameters.values() if item.kind is not item.VAR_KEYWORD]
    added = []
    for figure in FIGURES:
        kind = Annotated[
            float | None, typer.Option(option(figure.key), help=figure.text, parser=_reader(figure))
        ]
        added.append(
            inspect.Parameter(figure.key, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)
        )
    vars(new)["__signature__"] = signature.replace(parameters=[*fixed, *added])


def show(
    path: MotorArgument,
    picture: Annotated[
        Path | None, valued("--picture", "FILE", "Draw what the file means: .png, .svg or .pdf.")
    ] = None,
    like: Annotated[
        Path | None,
        valued("--like", "NAME", "Run by that drive, a preset or a file: its link, output and peak current."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show figures derived from a motor file, in a data sheet's terms.

    The picture: torque over speed at the voltage of the link, and of what the file has: torque over current
    of iron that saturates, friction over speed, the coupling's frequency response, cogging over the angle.

    Examples:
      hil motor show motor.toml
      hil motor show maxon-ec-40-48v --like epos4-50-5
    """
    from servobench.design.motor import motor_figures

    file, field = motor_file(path), None
    parameters = file.parameters
    if like is not None:
        from servobench.drivers.bounded_file import NamedBy
        from servobench.hil.configuration.drive_model import load_drive_model

        drive = load_drive_model(like, NamedBy("--like", "", str(like)))
        parameters, field = drive.runs(parameters), drive.field.parameters
    figures = {"name": parameters.name, **motor_figures(parameters)}
    twin = {} if file.twin is None else {"twin": file.twin.model_dump(mode="json", exclude_none=True)}
    put(figures | twin, as_json, _print)
    if picture is not None:
        from servobench.hil.studies.motor.drawing import draw_motor

        draw_motor(parameters, picture, *([] if field is None else [field]))
        say_written(picture)


def _print(figures: dict[str, Any]) -> None:
    from rich.console import Console

    table = columns("figure", "value", right=("value",))
    for key, value in figures.items():
        if key != "twin":
            table.add_row(key, value if isinstance(value, str) else f"{value:.5g}")
    Console().print(table)
    if "twin" in figures:
        _print_twin(figures["twin"])


def _print_twin(twin: dict[str, Any]) -> None:
    """Print what a fit found of the motor, and where it holds."""
    from rich.console import Console

    table = columns("twin", "value", "k = 2", "source", right=("value", "k = 2"))
    for key in twin["key"]:
        width = f"{key['uncertainty']:.2g}" if "uncertainty" in key else ""
        table.add_row(key["name"], f"{key['value']:.7g}", width, key["source"])
    Console().print(table)
    low, high = twin["speed_rpm"]
    weakest, strongest = twin["torque_nm"]
    windows = sum(each["windows"] for each in twin["recording"] if not each["held_out"])
    basis = f"{windows} windows of {len(twin['recording'])} recordings"
    typer.echo(f"holds from {low:g} to {high:g} r/min and {weakest:g} to {strongest:g} N m; by {basis}")


_with_figures()
add_commands(motor, new, show)
