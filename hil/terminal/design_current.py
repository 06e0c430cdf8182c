"""``hil design current``: an H-infinity current controller for one axis of a motor."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.terminal.options import (
    ControllerOutOption,
    JsonOption,
    MotorArgument,
    flag,
    gamma_option,
    motor_file,
)
from hil.terminal.output import put, say_written

if TYPE_CHECKING:
    from hil.studies.current.design import CurrentResult
    from hil.studies.current.figures import OtherAxis


class CurrentAxis(StrEnum):
    """Which current."""

    Q = "q"
    D = "d"


class StructureName(StrEnum):
    """What the controller may be."""

    FULL = "full"
    PI = "pi"
    PI_POLE = "pi+pole"
    THIRD = "third-order"


class ReduceBy(StrEnum):
    """How states are dropped."""

    TRUNCATE = "truncate"
    RESIDUALISE = "residualise"
    PAPER = "paper"


WeightsOption = Annotated[
    Path | None, typer.Option("--weights", metavar="FILE", help="Weights; the paper's rules if absent.")
]
GammaFactorOption = Annotated[
    float | None, typer.Option("--gamma-factor", min=1.0, help="The norm as a multiple of gamma_min.")
]
ReduceOption = Annotated[int | None, typer.Option("--reduce", metavar="N", min=1, help="States to keep.")]
RateOption = Annotated[
    float | None, typer.Option("--sample-rate-hz", metavar="FS", min=1.0, help="Sample the controller.")
]
DelayOption = Annotated[
    int, typer.Option("--delay-samples", metavar="N", min=0, max=10, help="Computation delay, periods.")
]
DiscreteOption = Annotated[
    bool,
    flag("--discrete", "Design for the sampled plant with its delay, instead of Tustin's rule."),
]
MarginOption = Annotated[
    float | None,
    typer.Option("--modulus-margin", min=0.01, max=1.0, help="Margin for the lowest rate recommended."),
]
OtherOption = Annotated[
    Path | None,
    typer.Option("--other", metavar="FILE", help="The other axis' controller; by the rules if absent."),
]
SpeedOption = Annotated[
    float | None,
    typer.Option("--speed-rpm", min=0.0, help="Both axes are looked at up to here; rated if absent."),
]
DecouplingOption = Annotated[
    float,
    typer.Option("--decoupling-factor", min=0.0, help="The drive's inductances beside the motor's."),
]
AdvanceOption = Annotated[
    float | None,
    typer.Option("--advance-periods", help="Angle advance; delay + 0.5 periods is right."),
]
PictureOption = Annotated[
    Path | None, typer.Option("--picture", metavar="FILE.png", help="Weights against |S|, |KS|, |T|.")
]


def current(
    motor: MotorArgument,
    axis: Annotated[CurrentAxis, typer.Option("--axis", help="The current to control.")],
    weights: WeightsOption = None,
    gamma: Annotated[float | None, gamma_option(1e-9)] = None,
    gamma_factor: GammaFactorOption = None,
    structure: Annotated[StructureName, typer.Option("--structure")] = StructureName.FULL,
    reduce: ReduceOption = None,
    reduce_by: Annotated[ReduceBy, typer.Option("--reduce-by")] = ReduceBy.TRUNCATE,
    sample_rate_hz: RateOption = None,
    delay_samples: DelayOption = 1,
    discrete: DiscreteOption = False,
    modulus_margin: MarginOption = None,
    other: OtherOption = None,
    speed_rpm: SpeedOption = None,
    decoupling_factor: DecouplingOption = 1.0,
    advance_periods: AdvanceOption = None,
    out: ControllerOutOption = None,
    picture: PictureOption = None,
    as_json: JsonOption = False,
) -> None:
    """Design a current controller: synthesis, reduction, sampling, margins and robustness."""
    from design.hinf.reduction import Method
    from drivers.errors import BadInput
    from drivers.rotation import RAD_S_PER_RPM
    from hil.configuration.weights_file import load_weights
    from hil.studies.current.design import design_current
    from hil.studies.current.figures import CurrentRequest
    from hil.terminal.design_errors import refused

    if gamma is not None and gamma_factor is not None:
        raise BadInput("--gamma-factor", "", gamma_factor, "either --gamma or --gamma-factor")
    if discrete and sample_rate_hz is None:
        raise BadInput("--discrete", "", discrete, "--sample-rate-hz with it")
    request = CurrentRequest(
        motor=motor_file(motor).parameters,
        axis=axis.value,
        weights=load_weights(weights) if weights else None,
        gamma=gamma,
        gamma_factor=gamma_factor,
        structure=structure.value,
        order=reduce,
        method=Method(reduce_by.value),
        rate_hz=sample_rate_hz,
        delay_samples=delay_samples,
        discrete=discrete,
        modulus_margin=modulus_margin,
        other=_other_axis(other, axis.value),
        speed_max_rad_s=None if speed_rpm is None else speed_rpm * RAD_S_PER_RPM,
        decoupling_factor=decoupling_factor,
        advance_periods=advance_periods,
    )
    with refused(f"axis {axis.value}"):
        result = design_current(request)
    _finish(result, axis.value, out, picture, as_json)


def _other_axis(path: Path | None, axis: str) -> "OtherAxis | None":
    """The continuous controller in ``path``, made for the axis that is not designed."""
    from drivers.bounded_file import NamedBy
    from hil.configuration.current_controller_file import load_current_controller
    from hil.studies.current.figures import OtherAxis

    if path is None:
        return None
    controller = load_current_controller(path, NamedBy("--other", "", str(path)), "d" if axis == "q" else "q")
    return OtherAxis(
        controller.continuous(), controller.prewarp_rad_s if controller.kind == "continuous" else 0.0
    )


def _finish(
    result: "CurrentResult", axis: str, out: Path | None, picture: Path | None, as_json: bool
) -> None:
    from hil.terminal.current_report import print_result

    put(result.figures, as_json, lambda _figures: print_result(result))
    if out is not None:
        from drivers.bounded_file import write_file
        from hil.studies.current.design import controller_text

        write_file("--out", out, controller_text(result, axis))
        say_written(out)
    if picture is not None:
        from hil.studies.current.pictures import draw_bounds

        draw_bounds(result.chosen, picture)
        say_written(picture)
