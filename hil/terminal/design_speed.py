"""``hil design speed``: the best speed feedback for a delay, a measured network, or a required gain."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.analyse_speed import (
    LOSSES_MAX,
    LoadOption,
    SpeedOption,
    StrategyName,
    SyncWithinOption,
)
from servobench.hil.terminal.current_loop_options import CurrentLoopOptions
from servobench.hil.terminal.design_predictor import PredictorOptions, design_dynamic
from servobench.hil.terminal.options import (
    JsonOption,
    MotorArgument,
    controller_out_option,
    flag,
    given,
    rigid_motor,
    valued,
)
from servobench.hil.terminal.output import on_terminal, print_figures, put, say_written
from servobench.hil.verdict.verdict import ExitStatus

if TYPE_CHECKING:
    from servobench.design.motor import PmsmParameters
    from servobench.design.sampled.held_loop import SampledNetwork
    from servobench.hil.configuration.config_files import Section
    from servobench.hil.studies.speed.dynamic import DynamicResult
    from servobench.hil.studies.speed.synthesis import DesignResult


_WHOLE = 0.05
"""Part of a period by which an age may exceed a whole number and still count as one. Where commands act at
SYNCs it is whole, but for the lateness of SYNCs and the clock's measurement error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedDesignOptions:
    """Options of ``hil design speed``."""

    motor: MotorArgument
    gamma: Annotated[float | None, valued("--gamma", "G", "Gain to keep, rad/s per N m.", min=1e-9)] = None
    error_percent: Annotated[
        float | None,
        valued("--error-percent", "P", "The same, as error in % of the speed under the load.", min=1e-9),
    ] = None
    load_nm: LoadOption = None
    speed_rpm: SpeedOption = None
    current_loop: CurrentLoopOptions
    delay_ms: Annotated[float | None, valued("--delay-ms", "D", "The constant delay.", min=0.0)] = None
    network: Annotated[
        Path | None, valued("--network", "NETWORK.toml", "Network file, e.g. one measured by hil run.")
    ] = None
    strategy: Annotated[
        StrategyName, valued("--strategy", None, "When a sample is applied on this network.")
    ] = "arrival"
    delay_margin_percent: Annotated[
        float,
        valued("--delay-margin-percent", None, "Margin on the network's largest delay.", min=0.0, max=1000.0),
    ] = 0.0
    extra_losses: Annotated[
        int, valued("--extra-losses", None, "Consecutive losses beyond the measured ones.", min=0, max=1000)
    ] = 0
    sync_within_us: SyncWithinOption = None
    method: Annotated[
        Literal["exact", "lmi", "ccl"],
        valued("--method", None, "Exact optimum, best LMI certificate, or the paper's Algorithm 4.2 (ccl)."),
    ] = "exact"
    feedback: Annotated[
        Literal["full", "speed"],
        valued("--feedback", None, "Feedback of current and speed, or of speed only."),
    ] = "full"
    integral: Annotated[bool, flag("--integral", "With integral action on the speed error.")] = False
    integral_time_ms: Annotated[
        float | None,
        valued("--integral-time-ms", "TI", "K2/K3; default: proportional to the delay.", min=1e-3),
    ] = None
    target: Annotated[
        Literal["constant", "sampled"],
        valued("--target", None, "Optimise the loop with constant delay, or the sampled one on the network."),
    ] = "constant"
    structure: Annotated[
        Literal["static", "predictor", "fused", "hinf"],
        valued(
            "--structure",
            None,
            "Static gain, predictor (Kalman filter, load cancelled), the same fused with the position "
            "of the speed's own SYNC, or H-infinity output feedback.",
        ),
    ] = "static"
    predictor: PredictorOptions
    out: Annotated[Path | None, controller_out_option("CONTROLLER.toml")] = None
    as_json: JsonOption = False


def speed(asked: SpeedDesignOptions) -> None:
    """Design a speed feedback: give the known values, the open ones are optimised.

    With a gain or an error: the largest delay. With a delay or a network: the least gain. With both: the
    least gain, and whether it suffices. A network's delay is that of [Ling2012] (2.13), and the loop as it
    runs is certified as well. A predictor and an H-infinity controller are designed for a delay or a network:
    for the least peak after the load step.

    Examples:
      hil design speed motor.toml --delay-ms 2 --load-nm 0.5   # some minutes
    """
    static = asked.structure == "static"
    if static:
        _check_static(asked)
    else:
        _refuse_static(asked)
    motor = rigid_motor(asked.motor, knows_coupling=static)
    inner = asked.current_loop.known_loop()
    network = _network(asked.network, asked) if asked.network else None
    design = _design_static if static else _design_dynamic
    result = design(asked, motor, inner.bandwidth_hz, network)
    put({"current_bandwidth_from": inner.key, **result.figures}, asked.as_json, print_figures)
    if asked.out is not None:
        from servobench.drivers.written_file import write_file
        from servobench.hil.studies.speed.controller_text import controller_text

        write_file("--out", asked.out, controller_text(_controller(result)))
        say_written(asked.out)


def _check_static(asked: SpeedDesignOptions) -> None:
    """Refuse both options of a pair, none at all, and options unknown to the method. Raises BadInput."""
    for option, value in asked.predictor.given.items():
        raise BadInput(option, "", value, "--structure predictor or hinf with it")
    if asked.gamma is not None and asked.error_percent is not None:
        raise BadInput("--error-percent", "", asked.error_percent, "either --gamma or --error-percent")
    if asked.delay_ms is not None and asked.network is not None:
        raise BadInput("--network", "", str(asked.network), "either --delay-ms or --network")
    if not given(asked, "gamma", "error_percent", "delay_ms", "network"):
        expected = "--gamma or --error-percent, --delay-ms or --network, or one of each"
        raise BadInput("hil design speed", "", None, expected)
    if asked.sync_within_us is not None and asked.network is None:
        raise BadInput(
            "--sync-within-us", "", asked.sync_within_us, "--network, whose loop is certified, with it"
        )
    exact = asked.method == "exact"
    if asked.method == "ccl" and (asked.feedback == "speed" or asked.integral):
        expected = "full feedback without integral: Algorithm 4.2 knows no other"
        raise BadInput("--method", "", asked.method, expected)
    if asked.integral_time_ms is not None and not (asked.integral and exact):
        expected = "--integral and --method exact with it"
        raise BadInput("--integral-time-ms", "", asked.integral_time_ms, expected)
    if asked.target == "sampled" and (asked.network is None or not exact):
        raise BadInput("--target", "", asked.target, "--network and --method exact with it")


def _refuse_static(asked: SpeedDesignOptions) -> None:
    """Refuse options without a use for predictor and hinf. Raises BadInput."""
    if asked.sync_within_us is not None and asked.structure != "hinf":
        expected = "--structure static or hinf: the predictors' certificates are for a constant period"
        raise BadInput("--sync-within-us", "", asked.sync_within_us, expected)
    static = given(asked, "gamma", "error_percent", "integral_time_ms")
    for option, value in (static | ({"--integral": True} if asked.integral else {})).items():
        raise BadInput(option, "", value, "nothing of it with --structure predictor or hinf")


def _seconds(time_ms: float | None) -> float | None:
    return None if time_ms is None else 1e-3 * time_ms


def _network(path: Path, asked: SpeedDesignOptions) -> "SampledNetwork":
    from servobench.design.sampled.held_loop import SampledNetwork, Strategy
    from servobench.hil.configuration.network_file import commands_unknown, load_network, losses_unseen

    measured = load_network(path)
    if (unknown := commands_unknown(measured, str(path))) is not None:
        raise unknown
    if unseen := losses_unseen(measured, str(path)):
        typer.echo(f"hil: warning: {unseen}", err=True)
    strategy, losses_max = Strategy(asked.strategy), measured.losses_max + asked.extra_losses
    tau_s = measured.delay_max_s * (1.0 + 0.01 * asked.delay_margin_percent)
    if losses_max > LOSSES_MAX:
        remedy = (
            "an outage is no pattern to design for: take it out of the file, and let a limit stop the bench"
        )
        expected = f"at most {LOSSES_MAX} in all"
        raise BadInput(str(path), "network.losses_in_a_row_max", losses_max, expected, remedy)
    agreed_s = 0.0 if strategy is Strategy.ARRIVAL else (losses_max + 1) * measured.period_s + tau_s
    if strategy is Strategy.STAMP:
        # A bench with this strategy acts at SYNCs only.
        agreed_s = math.ceil(agreed_s / measured.period_s - _WHOLE) * measured.period_s
    uneven_s = 1e-6 * (asked.sync_within_us or 0)
    return SampledNetwork(strategy, measured.period_s, losses_max, tau_s, agreed_s, uneven_s)


def _design_dynamic(
    asked: SpeedDesignOptions, motor: "PmsmParameters", bandwidth_hz: float, network: "SampledNetwork | None"
) -> "DynamicResult":
    return design_dynamic(
        asked.structure,
        asked.predictor,
        motor,
        bandwidth_hz,
        asked.delay_ms,
        network,
        asked.load_nm,
        1e-6 * (asked.sync_within_us or 0),
    )


def _design_static(
    asked: SpeedDesignOptions, motor: "PmsmParameters", bandwidth_hz: float, network: "SampledNetwork | None"
) -> "DesignResult":
    from servobench.design.delay.delay_loop import Feedback, gain_for_error
    from servobench.design.errors import DesignError
    from servobench.drivers.rotation import RAD_S_PER_RPM
    from servobench.hil.studies.speed.synthesis import (
        DesignRequest,
        Unreachable,
        Way,
        design_speed,
        with_bandwidths,
    )

    way = Way(
        asked.method,
        Feedback(asked.feedback),
        asked.integral,
        _seconds(asked.integral_time_ms),
        for_sampled=asked.target == "sampled",
    )
    load_nm = asked.load_nm or motor.rated_torque_nm
    at_rad_s = asked.speed_rpm * RAD_S_PER_RPM if asked.speed_rpm else motor.rated_speed_rad_s
    gamma = gain_for_error(asked.error_percent, load_nm, at_rad_s) if asked.error_percent else asked.gamma
    delay_s = network.constant_delay_s if network else _seconds(asked.delay_ms)
    request = DesignRequest(motor, gamma, delay_s, network, way, load_nm, at_rad_s, bandwidth_hz)
    try:
        result = design_speed(request, on_terminal)
        return result if asked.out is None else with_bandwidths(result)
    except Unreachable as error:
        if asked.as_json:
            typer.echo(json.dumps(error.figures, allow_nan=False))
        typer.echo(f"hil: {error}", err=True)
        raise typer.Exit(ExitStatus.BAD_INPUT) from None
    except DesignError as error:
        raise BadInput("hil design speed", "", str(error), "a design that exists") from error


def _controller(result: "DesignResult | DynamicResult") -> "Section":
    """Return the controller's table. Raises BadInput for a loop over a network that is not certified."""
    from servobench.hil.studies.speed.controller_text import controller_of
    from servobench.hil.studies.speed.synthesis import DesignResult

    if not isinstance(result, DesignResult):
        return result.controller()
    if result.sampled is not None and not result.sampled.certified:
        expected = "a loop that is certified; another --strategy or a shorter period may be"
        raise BadInput("--out", "", result.sampled.without_certificate, expected)
    return controller_of(result)
