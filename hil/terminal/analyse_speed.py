"""``hil analyse speed``: what delay, sampling and loss do to a speed loop."""

import math
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drivers.errors import BadInput
from hil.terminal.current_loop_options import (
    AxisOption,
    BenchOption,
    CommissionedOption,
    CurrentBandwidthOption,
    current_loop,
)
from hil.terminal.options import JsonOption, MotorArgument, flag, motor_file, seed_option, valued
from hil.terminal.output import print_figures, put

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from design.sampled.held_loop import SampledNetwork
    from design.speed.monte_carlo import Chance


class StrategyName(StrEnum):
    """When a sample is applied."""

    ARRIVAL = "arrival"
    STAMP = "stamp"
    HISTORY = "history"


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
GainOption = Annotated[
    str, valued("--gain", "K1,K2", r"Gain on \[i_q error, speed error]; K3: its integral.")
]
DelayMsOption = Annotated[
    float | None,
    typer.Option(
        "--delay-ms", metavar="D", min=0.0, help="Constant delay; with stamp and history the agreed one."
    ),
]
OrderOption = Annotated[
    int | None,
    typer.Option("--order", metavar="N", min=0, max=12, help="Of the certificate; 0 is Theorem 3.3."),
]
AsPrintedOption = Annotated[
    bool, flag("--as-printed", "Theorems 3.1 and 3.3 in cvxpy, too, matrix by matrix as printed.")
]
PeriodMsOption = Annotated[
    float | None,
    typer.Option("--period-ms", metavar="H", min=1e-6, help="Sampling period: the sampled loop."),
]
StrategyOption = Annotated[StrategyName | None, typer.Option("--strategy", help="When a sample is applied.")]
LossMaxOption = Annotated[
    int | None,
    typer.Option("--loss-max", metavar="D", min=0, max=50, help="Most samples lost in a row."),
]
TauMaxMsOption = Annotated[
    float | None,
    typer.Option("--tau-max-ms", metavar="T", min=0.0, help="Largest delay from sample to actuator."),
]
MonteCarloOption = Annotated[
    int | None, typer.Option("--monte-carlo", metavar="N", min=1, help="Random runs of the sampled loop.")
]
SeedOption = Annotated[int, seed_option("Of the random runs.")]
LossProbabilityOption = Annotated[
    float, typer.Option("--loss-probability", min=0.0, max=1.0, help="Of each sample in the random runs.")
]
UncertaintyPercentOption = Annotated[
    float,
    typer.Option("--uncertainty-percent", min=0.0, max=99.0, help="Of R, L, J, B and K_t in the runs."),
]
DurationSOption = Annotated[
    float, typer.Option("--duration-s", min=1e-3, max=3600.0, help="Length of a random run.")
]


def speed(
    motor: MotorArgument,
    gain: GainOption,
    delay_ms: DelayMsOption = None,
    order: OrderOption = None,
    as_printed: AsPrintedOption = False,
    bench: BenchOption = None,
    axis: AxisOption = None,
    commissioned: CommissionedOption = None,
    current_bandwidth_hz: CurrentBandwidthOption = None,
    speed_rpm: SpeedOption = None,
    load_nm: LoadOption = None,
    period_ms: PeriodMsOption = None,
    strategy: StrategyOption = None,
    loss_max: LossMaxOption = None,
    tau_max_ms: TauMaxMsOption = None,
    monte_carlo: MonteCarloOption = None,
    seed: SeedOption = 0,
    loss_probability: LossProbabilityOption = 0.1,
    uncertainty_percent: UncertaintyPercentOption = 0.0,
    duration_s: DurationSOption = 1.0,
    as_json: JsonOption = False,
) -> None:
    """Stability, gain and largest delay of a speed loop: exact, certified, sampled, and by chance.

    Gains are from load torque to speed error, rad/s per N m; the load step is one of 1 N m.
    """
    gains, parameters = _gain_of(gain), motor_file(motor).parameters
    network = _network(period_ms, strategy, loss_max, tau_max_ms, delay_ms)
    inner = current_loop(bench, axis, commissioned, current_bandwidth_hz)
    delay_s = _delay_s(delay_ms, network)

    from design.errors import DesignError
    from drivers.rotation import RAD_S_PER_RPM
    from hil.studies.speed.analysis import (
        LoopRequest,
        chance_figures,
        continuous_figures,
        figures_as_printed,
        sampled_figures,
    )

    request = LoopRequest(
        motor=parameters,
        K=gains,
        delay_s=delay_s,
        order=order,
        current_bandwidth_hz=inner.bandwidth_hz,
        load_nm=load_nm or parameters.rated_torque_nm,
        speed_rad_s=speed_rpm * RAD_S_PER_RPM if speed_rpm else parameters.rated_speed_rad_s,
    )
    chance = _chance(monte_carlo, seed, loss_probability, uncertainty_percent, duration_s, request.load_nm)
    if chance is not None and network is None:
        raise BadInput("--monte-carlo", "", monte_carlo, "a sampled loop: --period-ms and the network")
    try:
        figures = {"current_bandwidth_from": inner.key} | continuous_figures(request)
        if as_printed:
            figures["as_printed"] = figures_as_printed(request)
        if network is not None:
            figures |= sampled_figures(request, network)
            if chance is not None:
                figures["monte_carlo"] = chance_figures(request, network, chance)
    except DesignError as error:
        raise BadInput(str(motor), "", str(error), "a loop that can be analysed") from error
    put(figures, as_json, print_figures)


def _network(
    period_ms: float | None,
    strategy: StrategyName | None,
    loss_max: int | None,
    tau_max_ms: float | None,
    delay_ms: float | None,
) -> "SampledNetwork | None":
    """The network that the options describe; None if they describe none. Raises BadInput."""
    if period_ms is None:
        given: dict[str, Any] = {"--strategy": strategy, "--loss-max": loss_max, "--tau-max-ms": tau_max_ms}
        for option, value in given.items():
            if value is not None:
                raise BadInput(option, "", str(value), "--period-ms with it, the sampling period")
        return None
    from design.errors import UnsuitableNetwork
    from design.sampled.held_loop import SampledNetwork, Strategy

    wanted = Strategy((strategy or StrategyName.ARRIVAL).value)
    period_s, tau_s, most = 1e-3 * period_ms, 1e-3 * (tau_max_ms or 0.0), loss_max or 0
    # [Ling2012] (2.13)
    agreed_s = 1e-3 * delay_ms if delay_ms is not None else (most + 1) * period_s + tau_s
    if wanted is Strategy.ARRIVAL:
        agreed_s = 0.0
    try:
        return SampledNetwork(wanted, period_s, most, tau_s, agreed_s)
    except UnsuitableNetwork as error:
        raise BadInput("--strategy", "", error.found, error.expected) from None


def _delay_s(delay_ms: float | None, network: "SampledNetwork | None") -> float:
    """The constant delay of the continuous figures: as given, else the longest of [Ling2012] (2.13).

    Raises BadInput where nothing tells it.
    """
    if delay_ms is not None:
        return 1e-3 * delay_ms
    if network is None:
        raise BadInput(
            "--delay-ms", "", None, "the constant delay, ms", "or give --period-ms and the network"
        )
    return network.constant_delay_s


def _chance(
    runs: int | None, seed: int, loss: float, uncertainty_percent: float, duration_s: float, load_nm: float
) -> "Chance | None":
    if runs is None:
        return None
    from design.speed.monte_carlo import Chance

    return Chance(
        runs=runs,
        seed=seed,
        duration_s=duration_s,
        loss_probability=loss,
        load_nm=load_nm,
        uncertainty=0.01 * uncertainty_percent,
    )


def _gain_of(text: str) -> "NDArray[np.float64]":
    """``K1,K2`` or ``K1,K2,K3``. Raises BadInput."""
    import numpy as np

    expected = "K1,K2 in A/A and A s/rad, or K1,K2,K3 with the integral gain in A/rad, all finite"
    try:
        gains = [float(part) for part in text.split(",")]
    except ValueError:
        raise BadInput("--gain", "", text, expected) from None
    if len(gains) not in (2, 3) or not all(map(math.isfinite, gains)):
        raise BadInput("--gain", "", text, expected)
    return np.array(gains)
