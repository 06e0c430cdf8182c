"""``hil design current``: an H-infinity current controller for one axis of a motor."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from servobench.hil.terminal.options import (
    ControllerOutOption,
    JsonOption,
    MotorArgument,
    flag,
    gamma_option,
    motor_file,
    valued,
)
from servobench.hil.terminal.output import put, say_written

if TYPE_CHECKING:
    from servobench.hil.studies.current.design import OtherAxis


@dataclass(frozen=True, slots=True, kw_only=True)
class CurrentDesignOptions:
    """Options of ``hil design current``."""

    motor: MotorArgument
    axis: Annotated[Literal["q", "d"], valued("--axis", None, "The current to control.")]
    weights: Annotated[Path | None, valued("--weights", "FILE", "Weights; default: the paper's rules.")] = (
        None
    )
    gamma: Annotated[float | None, gamma_option(1e-9)] = None
    gamma_factor: Annotated[
        float | None, valued("--gamma-factor", None, "The norm as a multiple of gamma_min.", min=1.0)
    ] = None
    structure: Annotated[Literal["full", "pi", "pi+pole", "third-order"], typer.Option("--structure")] = (
        "full"
    )
    reduce: Annotated[int | None, valued("--reduce", "N", "Number of states to keep.", min=1)] = None
    reduce_by: Annotated[Literal["truncate", "residualise", "paper"], typer.Option("--reduce-by")] = (
        "truncate"
    )
    sample_rate_hz: Annotated[
        float | None, valued("--sample-rate-hz", "FS", "Rate of the sampled controller.", min=1.0)
    ] = None
    delay_samples: Annotated[
        int, valued("--delay-samples", "N", "Computation delay, periods.", min=0, max=10)
    ] = 1
    discrete: Annotated[
        bool, flag("--discrete", "Design for the sampled plant with its delay, instead of Tustin's rule.")
    ] = False
    modulus_margin: Annotated[
        float | None,
        valued(
            "--modulus-margin", None, "Modulus margin for the lowest recommended rate.", min=0.01, max=1.0
        ),
    ] = None
    other: Annotated[
        Path | None, valued("--other", "FILE", "The other axis' controller; default: by the rules.")
    ] = None
    speed_rpm: Annotated[
        float | None,
        valued("--speed-rpm", None, "Speed up to which both axes are analysed; default: rated.", min=0.0),
    ] = None
    decoupling_factor: Annotated[
        float,
        valued("--decoupling-factor", None, "Ratio of the drive's inductances to the motor's.", min=0.0),
    ] = 1.0
    advance_periods: Annotated[
        float | None, valued("--advance-periods", None, "Angle advance, periods; delay + 0.5 is correct.")
    ] = None
    out: ControllerOutOption = None
    picture: Annotated[
        Path | None, valued("--picture", "FILE.png", "Plot of the weights and |S|, |KS|, |T|.")
    ] = None
    as_json: JsonOption = False


def current(asked: CurrentDesignOptions) -> None:
    """Design a current controller: synthesis, reduction, sampling, margins and robustness.

    Examples:
      hil design current motor.toml --axis q --sample-rate-hz 16000 --out q.toml
    """
    from servobench.design.hinf.reduction import Method
    from servobench.drivers.errors import BadInput
    from servobench.drivers.rotation import RAD_S_PER_RPM
    from servobench.drivers.written_file import write_file
    from servobench.hil.configuration.design_files import load_weights
    from servobench.hil.studies.current.design import CurrentRequest, controller_text, design_current
    from servobench.hil.terminal.current_report import print_result, refused

    if asked.gamma is not None and asked.gamma_factor is not None:
        raise BadInput("--gamma-factor", "", asked.gamma_factor, "either --gamma or --gamma-factor")
    if asked.discrete and asked.sample_rate_hz is None:
        raise BadInput("--discrete", "", asked.discrete, "--sample-rate-hz with it")
    request = CurrentRequest(
        motor=motor_file(asked.motor).parameters,
        axis=asked.axis,
        weights=load_weights(asked.weights) if asked.weights else None,
        gamma=asked.gamma,
        gamma_factor=asked.gamma_factor,
        structure=asked.structure,
        order=asked.reduce,
        method=Method(asked.reduce_by),
        rate_hz=asked.sample_rate_hz,
        delay_samples=asked.delay_samples,
        discrete=asked.discrete,
        modulus_margin=asked.modulus_margin,
        other=_other_axis(asked.other, asked.axis),
        speed_max_rad_s=None if asked.speed_rpm is None else asked.speed_rpm * RAD_S_PER_RPM,
        decoupling_factor=asked.decoupling_factor,
        advance_periods=asked.advance_periods,
    )
    with refused(f"axis {asked.axis}"):
        result = design_current(request)
    put(result.figures, asked.as_json, lambda _figures: print_result(result))
    if asked.out is not None:
        write_file("--out", asked.out, controller_text(result, asked.axis))
        say_written(asked.out)
    if asked.picture is not None:
        from servobench.hil.studies.current.pictures import draw_bounds

        draw_bounds(result.chosen, asked.picture)
        say_written(asked.picture)


def _other_axis(path: Path | None, axis: str) -> "OtherAxis | None":
    """Load the continuous controller in ``path``, made for the other axis."""
    from servobench.drivers.bounded_file import NamedBy
    from servobench.hil.configuration.controller_files import load_current_controller
    from servobench.hil.studies.current.design import OtherAxis

    if path is None:
        return None
    controller = load_current_controller(path, NamedBy("--other", "", str(path)), "d" if axis == "q" else "q")
    return OtherAxis(
        controller.continuous(), controller.prewarp_rad_s if controller.kind == "continuous" else 0.0
    )
