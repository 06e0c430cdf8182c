"""``hil design current``: an H-infinity current controller for one axis of a motor."""

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.terminal.exit_status import reported_errors

if TYPE_CHECKING:
    from hil.current_control import CurrentResult


class Axis(StrEnum):
    """Which current."""

    Q = "q"
    D = "d"


class StructureName(StrEnum):
    """What the controller may be."""

    FULL = "full"
    PI = "pi"
    PI_POLE = "pi+pole"
    THIRD = "third"


class ReduceBy(StrEnum):
    """How states are dropped."""

    TRUNCATE = "truncate"
    RESIDUALISE = "residualise"
    PAPER = "paper"


def current(
    motor: Annotated[Path, typer.Argument(metavar="MOTOR.toml", help="The motor file.")],
    axis: Annotated[Axis, typer.Option("--axis", help="The current to control.")],
    weights: Annotated[
        Path | None, typer.Option("--weights", metavar="FILE", help="Weights; the paper's rules if absent.")
    ] = None,
    gamma: Annotated[float | None, typer.Option("--gamma", min=1e-9, help="The norm to stay below.")] = None,
    gamma_factor: Annotated[
        float | None, typer.Option("--gamma-factor", min=1.0, help="The norm as a multiple of gamma_min.")
    ] = None,
    structure: Annotated[StructureName, typer.Option("--structure")] = StructureName.FULL,
    reduce: Annotated[
        int | None, typer.Option("--reduce", metavar="N", min=1, help="States to keep.")
    ] = None,
    reduce_by: Annotated[ReduceBy, typer.Option("--reduce-by")] = ReduceBy.TRUNCATE,
    sample_rate_hz: Annotated[
        float | None, typer.Option("--sample-rate-hz", metavar="FS", min=1.0, help="Sample the controller.")
    ] = None,
    delay_samples: Annotated[
        int, typer.Option("--delay-samples", metavar="N", min=0, max=10, help="Computation delay, periods.")
    ] = 1,
    direct: Annotated[
        bool, typer.Option("--direct", help="Design for the sampled plant itself, instead of Tustin's rule.")
    ] = False,
    modulus_margin: Annotated[
        float | None,
        typer.Option("--modulus-margin", min=0.01, max=1.0, help="Margin for the lowest rate recommended."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="The controller, for a bench file.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE.png", help="Weights against |S|, |KS|, |T|.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object on stdout, all else on stderr.")
    ] = False,
) -> None:
    """Design a current controller: synthesis, reduction, sampling, margins and robustness."""
    with reported_errors():
        from design.reduction import Method
        from drivers.errors import BadInput
        from hil.configuration.config_files import NamedBy
        from hil.configuration.motor_file import load_motor
        from hil.configuration.weights_file import load_weights
        from hil.current_control import CurrentRequest
        from hil.terminal.design_errors import designed

        if gamma is not None and gamma_factor is not None:
            raise BadInput("--gamma-factor", "", gamma_factor, "either --gamma or --gamma-factor")
        request = CurrentRequest(
            motor=load_motor(motor, NamedBy("MOTOR.toml", "", str(motor))).parameters,
            axis=axis.value,
            weights=load_weights(weights) if weights else None,
            gamma=gamma,
            gamma_factor=gamma_factor,
            structure=structure.value,
            order=reduce,
            method=Method(reduce_by.value),
            rate_hz=sample_rate_hz,
            delay_samples=delay_samples,
            direct=direct,
            modulus_margin=modulus_margin,
        )
        _finish(designed(request), axis.value, out, picture, as_json)


def _finish(
    result: "CurrentResult", axis: str, out: Path | None, picture: Path | None, as_json: bool
) -> None:
    if out is not None:
        from hil.current_control import write_controller

        write_controller(out, result, axis)
    if picture is not None:
        from hil.figures.current_loops import draw_bounds

        draw_bounds(result.chosen, picture)
    if as_json:
        typer.echo(json.dumps(result.figures, allow_nan=False))
    else:
        _print(result.figures)


def _print(figures: dict[str, Any], indent: str = "") -> None:
    for key, value in figures.items():
        if isinstance(value, dict):
            typer.echo(f"{indent}{key}")
            _print(value, indent + "  ")
        elif isinstance(value, float):
            typer.echo(f"{indent}{key:<28} {value:.6g}")
        elif isinstance(value, list):
            texts = [_number(item) for item in value]
            typer.echo(f"{indent}{key:<28} {'  '.join(texts)}")
        else:
            typer.echo(f"{indent}{key:<28} {value}")


def _number(item: Any) -> str:
    if isinstance(item, list):
        return f"{item[0]:.6g}" if item[1] == 0.0 else f"{item[0]:.6g}{item[1]:+.6g}j"
    return f"{item:.6g}"
