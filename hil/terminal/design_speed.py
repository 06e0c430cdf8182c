"""``hil design speed``: the best speed feedback for a delay, a measured network, or a wanted gain."""

import json
import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.errors import BadInput
from hil.terminal.analyse_speed import LoadOption, SpeedOption, StrategyName
from hil.terminal.current_loop_options import (
    AxisOption,
    BenchOption,
    CommissionedOption,
    CurrentBandwidthOption,
    current_loop,
)
from hil.terminal.design_predictor import (
    DeadTimeOption,
    EncoderCountsOption,
    LossesMaxOption,
    PeriodMsOption,
    PredictorOptions,
    SpeedFilterOption,
    TorqueNoiseOption,
    finish_predictor,
    refuse_given,
)
from hil.terminal.exit_status import reported_errors
from hil.terminal.options import JsonOption, MotorArgument, controller_out_option, flag, motor_file
from hil.terminal.output import on_terminal, print_figures, put, say_written
from hil.verdict.verdict import ExitStatus

if TYPE_CHECKING:
    from design.sampled.held_loop import SampledNetwork
    from hil.studies.speed.synthesis import DesignRequest


_LOSSES_MAX = 50
_WHOLE = 0.05
"""Part of a period by which an age may exceed a whole number of them and still count as one. Where commands
act at SYNCs it is one, but for the lateness of SYNCs and the error of the clock that measured it."""


class MethodName(StrEnum):
    """How the feedback is found."""

    EXACT = "exact"
    LMI = "lmi"
    CCL = "ccl"


class FeedbackName(StrEnum):
    """Which states it may use."""

    FULL = "full"
    SPEED = "speed"


class SpeedStructure(StrEnum):
    """What the feedback is."""

    STATIC = "static"
    PREDICTOR = "predictor"
    HINF = "hinf"


class TargetName(StrEnum):
    """Which loop is made best."""

    CONSTANT = "constant"
    SAMPLED = "sampled"


GammaOption = Annotated[
    float | None, typer.Option("--gamma", metavar="G", min=1e-9, help="Gain to keep, rad/s per N m.")
]
ErrorPercentOption = Annotated[
    float | None,
    typer.Option(
        "--error-percent", metavar="P", min=1e-9, help="The same: error in % of the speed under the load."
    ),
]
DelayMsOption = Annotated[
    float | None, typer.Option("--delay-ms", metavar="D", min=0.0, help="The constant delay.")
]
NetworkOption = Annotated[
    Path | None,
    typer.Option("--network", metavar="NETWORK.toml", help="A network, e.g. as hil run has measured it."),
]
StrategyOption = Annotated[
    StrategyName, typer.Option("--strategy", help="When a sample is applied on that network.")
]
DelayMarginPercentOption = Annotated[
    float,
    typer.Option("--delay-margin-percent", min=0.0, max=1000.0, help="On the network's largest delay."),
]
ExtraLossesOption = Annotated[
    int,
    typer.Option("--extra-losses", min=0, max=1000, help="In a row, beyond those that were measured."),
]
MethodOption = Annotated[
    MethodName,
    typer.Option("--method", help="exact optimum, best LMI certificate, or the paper's Algorithm 4.2 (ccl)."),
]
FeedbackOption = Annotated[FeedbackName, typer.Option("--feedback", help="Current and speed, or speed only.")]
IntegralOption = Annotated[bool, flag("--integral", "With integral action on the speed error.")]
IntegralTimeMsOption = Annotated[
    float | None,
    typer.Option(
        "--integral-time-ms", metavar="TI", min=1e-3, help="K2/K3; in proportion to the delay if absent."
    ),
]
TargetOption = Annotated[
    TargetName,
    typer.Option(
        "--target", help="Make best the loop with constant delay, or the sampled one on the network."
    ),
]
StructureOption = Annotated[
    SpeedStructure,
    typer.Option(
        "--structure",
        help="A static gain, a predictor (Kalman filter, load cancelled), or H-infinity output feedback.",
    ),
]
OutOption = Annotated[Path | None, controller_out_option("CONTROLLER.toml")]


def speed(
    motor: MotorArgument,
    gamma: GammaOption = None,
    error_percent: ErrorPercentOption = None,
    load_nm: LoadOption = None,
    speed_rpm: SpeedOption = None,
    bench: BenchOption = None,
    axis: AxisOption = None,
    commissioned: CommissionedOption = None,
    current_bandwidth_hz: CurrentBandwidthOption = None,
    delay_ms: DelayMsOption = None,
    network: NetworkOption = None,
    strategy: StrategyOption = StrategyName.ARRIVAL,
    delay_margin_percent: DelayMarginPercentOption = 0.0,
    extra_losses: ExtraLossesOption = 0,
    method: MethodOption = MethodName.EXACT,
    feedback: FeedbackOption = FeedbackName.FULL,
    integral: IntegralOption = False,
    integral_time_ms: IntegralTimeMsOption = None,
    target: TargetOption = TargetName.CONSTANT,
    structure: StructureOption = SpeedStructure.STATIC,
    period_ms: PeriodMsOption = None,
    encoder_counts: EncoderCountsOption = None,
    speed_filter_hz: SpeedFilterOption = None,
    drive_dead_time_us: DeadTimeOption = None,
    torque_noise_nm: TorqueNoiseOption = None,
    losses_max: LossesMaxOption = None,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Design a speed feedback: what is known is given, what is open is optimised.

    With a gain or an error: the largest delay. With a delay or a network: the least gain. With
    both: the least gain, and whether it is enough. A network's delay is that of [Ling2012] (2.13),
    and the loop that really runs over it is certified as well. A predictor and an H-infinity
    controller are designed for a delay or a network: for the least peak after the load step.
    """
    with reported_errors():
        asked = PredictorOptions(
            period_ms, encoder_counts, speed_filter_hz, drive_dead_time_us, torque_noise_nm, losses_max
        )
        if structure is not SpeedStructure.STATIC:
            _refuse_static(gamma, error_percent, integral_time_ms, integral)
        else:
            refuse_given(asked.given, "--structure predictor or hinf with it")
            _check_known(gamma, error_percent, delay_ms, network)
            _check_method(method, feedback, integral, integral_time_ms, target, network)
        parameters = motor_file(motor).parameters
        inner = current_loop(bench, axis, commissioned, current_bandwidth_hz)
        over = _network(network, strategy, delay_margin_percent, extra_losses) if network else None
        if structure is not SpeedStructure.STATIC:
            finish_predictor(
                structure.value, parameters, inner, asked, _seconds(delay_ms), over, load_nm, out, as_json
            )
            return

        from design.delay.speed_loop import Feedback, gain_for_error
        from drivers.rotation import RAD_S_PER_RPM
        from hil.studies.speed.synthesis import DesignRequest, Way

        sampled, integral_s = target is TargetName.SAMPLED, _seconds(integral_time_ms)
        way = Way(method.value, Feedback(feedback.value), integral, integral_s, sampled)
        load = load_nm or parameters.rated_torque_nm
        at_rad_s = speed_rpm * RAD_S_PER_RPM if speed_rpm else parameters.rated_speed_rad_s
        if error_percent:
            gamma = gain_for_error(error_percent, load, at_rad_s)
        delay_s = over.constant_delay_s if over else _seconds(delay_ms)
        request = DesignRequest(parameters, gamma, delay_s, over, way, load, at_rad_s, inner.bandwidth_hz)
        _finish(request, inner.key, out, as_json)


def _seconds(time_ms: float | None) -> float | None:
    return None if time_ms is None else 1e-3 * time_ms


def _check_method(
    method: MethodName,
    feedback: FeedbackName,
    integral: bool,
    integral_time_ms: float | None,
    target: TargetName,
    network: Path | None,
) -> None:
    """What each method knows. Raises BadInput."""
    if method is MethodName.CCL and (feedback is FeedbackName.SPEED or integral):
        expected = "full feedback without integral: Algorithm 4.2 knows no other"
        raise BadInput("--method", "", method.value, expected)
    if integral_time_ms is not None and not (integral and method is MethodName.EXACT):
        raise BadInput("--integral-time-ms", "", integral_time_ms, "--integral and --method exact with it")
    if target is TargetName.SAMPLED and (network is None or method is not MethodName.EXACT):
        raise BadInput("--target", "", target.value, "--network and --method exact with it")


def _refuse_static(
    gamma: float | None, error_percent: float | None, integral_time_ms: float | None, integral: bool
) -> None:
    """What these structures are not designed by. Raises BadInput."""
    static = {
        "--gamma": gamma,
        "--error-percent": error_percent,
        "--integral-time-ms": integral_time_ms,
        "--integral": integral or None,
    }
    refuse_given(static, "nothing of it with --structure predictor or hinf")


def _check_known(
    gamma: float | None, error_percent: float | None, delay_ms: float | None, network: Path | None
) -> None:
    """At most one of each pair, and at least one in all. Raises BadInput."""
    if gamma is not None and error_percent is not None:
        raise BadInput("--error-percent", "", error_percent, "either --gamma or --error-percent")
    if delay_ms is not None and network is not None:
        raise BadInput("--network", "", str(network), "either --delay-ms or --network")
    if all(value is None for value in (gamma, error_percent, delay_ms, network)):
        expected = "--gamma or --error-percent, --delay-ms or --network, or one of each"
        raise BadInput("hil design speed", "", None, expected)


def _network(path: Path, strategy: StrategyName, margin_percent: float, extra: int) -> "SampledNetwork":
    from design.sampled.held_loop import SampledNetwork, Strategy
    from hil.configuration.network_file import commands_unknown, load_network

    measured = load_network(path)
    if (unknown := commands_unknown(measured, str(path))) is not None:
        raise unknown
    wanted = Strategy(strategy.value)
    tau_s, most = measured.delay_max_s * (1.0 + 0.01 * margin_percent), measured.losses_max + extra
    if most > _LOSSES_MAX:
        remedy = (
            "an outage is no pattern to design for: take it out of the file, and let a limit stop the bench"
        )
        raise BadInput(
            str(path), "network.losses_in_a_row_max", most, f"at most {_LOSSES_MAX} in all", remedy
        )
    agreed_s = 0.0 if wanted is Strategy.ARRIVAL else (most + 1) * measured.period_s + tau_s
    if wanted is Strategy.STAMP:
        # A bench with this strategy acts at SYNCs only.
        agreed_s = math.ceil(agreed_s / measured.period_s - _WHOLE) * measured.period_s
    return SampledNetwork(wanted, measured.period_s, most, tau_s, agreed_s)


def _finish(request: "DesignRequest", bandwidth_from: str, out: Path | None, as_json: bool) -> None:
    from design.errors import DesignError
    from hil.studies.speed.synthesis import Unreachable, design_speed, with_bandwidths

    try:
        result = design_speed(request, on_terminal)
        if out is not None:
            result = with_bandwidths(result)
    except Unreachable as error:
        if as_json:
            typer.echo(json.dumps(error.figures, allow_nan=False))
        typer.echo(f"hil: {error}", err=True)
        raise typer.Exit(ExitStatus.BAD_INPUT) from None
    except DesignError as error:
        raise BadInput("hil design speed", "", str(error), "a design that exists") from error
    figures = {"current_bandwidth_from": bandwidth_from, **result.figures}
    put(figures, as_json, print_figures)
    if out is not None:
        from drivers.bounded_file import write_file
        from hil.studies.speed.controller_text import controller_of, controller_text

        if result.sampled is not None and not result.sampled.certified:
            expected = "a loop that is certified; another --strategy or a shorter period may be"
            raise BadInput("--out", "", result.sampled.without_certificate, expected)
        write_file("--out", out, controller_text(controller_of(result)))
        say_written(out)
