"""Options and figures that the commands on speed loops share."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drivers.errors import BadInput

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from design.motor import PmsmParameters

MotorArgument = Annotated[Path, typer.Argument(metavar="MOTOR.toml", help="The motor file.")]
SpeedOption = Annotated[
    float | None,
    typer.Option(
        "--speed-rpm", metavar="S", min=1e-6, help="Speed that percents are of; the rated if absent."
    ),
]
LoadOption = Annotated[
    float | None,
    typer.Option(
        "--load-nm", metavar="T", min=1e-9, help="Load step for percents; the rated torque if absent."
    ),
]


def motor_of(path: Path) -> "PmsmParameters":
    """The motor in a file. Raises BadInput or BadInputs."""
    from drivers.bounded_file import NamedBy
    from hil.configuration.motor_file import load_motor

    return load_motor(path, NamedBy("MOTOR.toml", "", str(path))).parameters


def gain_of(text: str) -> "NDArray[np.float64]":
    """``K1,K2`` or ``K1,K2,K3``. Raises BadInput."""
    import numpy as np

    expected = "K1,K2 in A/A and A s/rad, or K1,K2,K3 with the integral gain in A/rad, all finite"
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        raise BadInput("--gain", "", text, expected) from None
    if len(found) not in (2, 3) or not all(map(math.isfinite, found)):
        raise BadInput("--gain", "", text, expected)
    return np.array(found)


def print_figures(figures: dict[str, Any], indent: str = "") -> None:
    """Figures by name, tables inside one another, for the terminal."""
    for key, value in figures.items():
        if isinstance(value, dict):
            typer.echo(f"{indent}{key}")
            print_figures(value, indent + "  ")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            typer.echo(f"{indent}{key}")
            for item in value:
                typer.echo(f"{indent}  " + "   ".join(f"{name} {_text(part)}" for name, part in item.items()))
        elif isinstance(value, list):
            typer.echo(f"{indent}{key:<26} {'  '.join(map(_text, value))}")
        else:
            typer.echo(f"{indent}{key:<26} {_text(value)}")


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.7g}" if isinstance(value, float) else str(value)
