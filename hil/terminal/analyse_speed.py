"""``hil analyse speed``: the effect of delay, sampling and loss on a speed loop."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.current_loop_options import CurrentLoopOptions
from servobench.hil.terminal.options import (
    JsonOption,
    MotorArgument,
    flag,
    given,
    rigid_motor,
    seed_option,
    valued,
)
from servobench.hil.terminal.output import print_figures, put

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from servobench.design.sampled.held_loop import SampledNetwork
    from servobench.design.speed.monte_carlo import Chance


LOSSES_MAX = 50
"""Losses in a row: more is an outage, not a pattern to design for."""
StrategyName = Literal["arrival", "stamp", "history"]
"""When a sample is applied."""
SpeedOption = Annotated[
    float | None, valued("--speed-rpm", "S", "Speed that 100 % refers to; default: rated.", min=1e-6)
]
LoadOption = Annotated[
    float | None, valued("--load-nm", "T", "Load step for the percentages; default: rated torque.", min=1e-9)
]
SyncWithinOption = Annotated[
    int | None,
    valued(
        "--sync-within-us",
        "W",
        "Certify for SYNC distances that depart from the period by so much; default: 0, a constant period.",
        min=1,
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class AnalysisOptions:
    """Options of ``hil analyse speed``."""

    motor: MotorArgument
    gain: Annotated[str, valued("--gain", "K1,K2", r"Gain on \[i_q error, speed error]; K3: its integral.")]
    delay_ms: Annotated[
        float | None,
        valued("--delay-ms", "D", "Constant delay; with stamp and history the agreed one.", min=0.0),
    ] = None
    order: Annotated[
        int | None, valued("--order", "N", "Order of the certificate; 0 is Theorem 3.3.", min=0, max=12)
    ] = None
    as_printed: Annotated[
        bool, flag("--as-printed", "Also solve Theorems 3.1 and 3.3 in cvxpy, as printed.")
    ] = False
    current_loop: CurrentLoopOptions
    speed_rpm: SpeedOption = None
    load_nm: LoadOption = None
    period_ms: Annotated[
        float | None, valued("--period-ms", "H", "Sampling period; analyses the sampled loop.", min=1e-6)
    ] = None
    strategy: Annotated[StrategyName | None, valued("--strategy", None, "When a sample is applied.")] = None
    loss_max: Annotated[
        int | None,
        valued("--loss-max", "D", "Largest number of consecutive lost samples.", min=0, max=LOSSES_MAX),
    ] = None
    tau_max_ms: Annotated[
        float | None, valued("--tau-max-ms", "T", "Largest delay from sample to actuator.", min=0.0)
    ] = None
    sync_within_us: SyncWithinOption = None
    monte_carlo: Annotated[
        int | None, valued("--monte-carlo", "N", "Number of random runs of the sampled loop.", min=1)
    ] = None
    seed: Annotated[int, seed_option("Seed of the random runs.")] = 0
    loss_probability: Annotated[
        float,
        valued(
            "--loss-probability",
            None,
            "Loss probability of each sample in the random runs.",
            min=0.0,
            max=1.0,
        ),
    ] = 0.1
    uncertainty_percent: Annotated[
        float,
        valued(
            "--uncertainty-percent",
            None,
            "Uncertainty of R, L, J, B and K_t in the random runs.",
            min=0.0,
            max=99.0,
        ),
    ] = 0.0
    duration_s: Annotated[
        float, valued("--duration-s", None, "Duration of a random run.", min=1e-3, max=3600.0)
    ] = 1.0
    as_json: JsonOption = False


def speed(asked: AnalysisOptions) -> None:
    """Compute stability, gain and largest delay of a speed loop: exact, certified, sampled, and by chance.

    Gains are from load torque to speed error, rad/s per N m; the load step is one of 1 N m.

    Examples:
      hil analyse speed motor.toml --gain 0,-0.02 --delay-ms 10
    """
    gains, parameters = _gain_of(asked.gain), rigid_motor(asked.motor, knows_coupling=True)
    network = _network(asked)
    inner = asked.current_loop.known_loop()
    delay_s = _delay_s(asked.delay_ms, network)

    from servobench.design.errors import DesignError
    from servobench.drivers.rotation import RAD_S_PER_RPM
    from servobench.hil.studies.speed.analysis import (
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
        order=asked.order,
        current_bandwidth_hz=inner.bandwidth_hz,
        load_nm=asked.load_nm or parameters.rated_torque_nm,
        speed_rad_s=asked.speed_rpm * RAD_S_PER_RPM if asked.speed_rpm else parameters.rated_speed_rad_s,
    )
    chance = _chance(asked, request.load_nm)
    if chance is not None and network is None:
        raise BadInput("--monte-carlo", "", chance.runs, "a sampled loop: --period-ms and the network")
    try:
        figures = {"current_bandwidth_from": inner.key} | continuous_figures(request)
        if asked.as_printed:
            figures["as_printed"] = figures_as_printed(request)
        if network is not None:
            figures |= sampled_figures(request, network)
            if chance is not None:
                figures["monte_carlo"] = chance_figures(request, network, chance)
    except DesignError as error:
        raise BadInput(str(asked.motor), "", str(error), "a loop that can be analysed") from error
    put(figures, asked.as_json, print_figures)


def _network(asked: AnalysisOptions) -> "SampledNetwork | None":
    """Return the network that the options describe; None if they describe none. Raises BadInput."""
    if asked.period_ms is None:
        for option, value in given(asked, "strategy", "loss_max", "tau_max_ms", "sync_within_us").items():
            raise BadInput(option, "", str(value), "--period-ms with it, the sampling period")
        return None
    from servobench.design.errors import UnsuitableNetwork
    from servobench.design.sampled.held_loop import SampledNetwork, Strategy

    strategy, losses_max = Strategy(asked.strategy or "arrival"), asked.loss_max or 0
    period_s, tau_s = 1e-3 * asked.period_ms, 1e-3 * (asked.tau_max_ms or 0.0)
    # [Ling2012] (2.13)
    agreed_s = 1e-3 * asked.delay_ms if asked.delay_ms is not None else (losses_max + 1) * period_s + tau_s
    if strategy is Strategy.ARRIVAL:
        agreed_s = 0.0
    try:
        uneven_s = 1e-6 * (asked.sync_within_us or 0)
        return SampledNetwork(strategy, period_s, losses_max, tau_s, agreed_s, uneven_s)
    except UnsuitableNetwork as error:
        raise BadInput("--strategy", "", error.found, error.expected) from None


def _delay_s(delay_ms: float | None, network: "SampledNetwork | None") -> float:
    """Return the constant delay of the continuous figures: as given, else the longest of [Ling2012] (2.13).

    Raises BadInput if neither is known.
    """
    if delay_ms is not None:
        return 1e-3 * delay_ms
    if network is None:
        raise BadInput(
            "--delay-ms", "", None, "the constant delay, ms", "or give --period-ms and the network"
        )
    return network.constant_delay_s


def _chance(asked: AnalysisOptions, load_nm: float) -> "Chance | None":
    if asked.monte_carlo is None:
        return None
    from servobench.design.speed.monte_carlo import Chance

    return Chance(
        runs=asked.monte_carlo,
        seed=asked.seed,
        duration_s=asked.duration_s,
        loss_probability=asked.loss_probability,
        load_nm=load_nm,
        uncertainty=0.01 * asked.uncertainty_percent,
    )


def _gain_of(text: str) -> "NDArray[np.float64]":
    """Parse ``K1,K2`` or ``K1,K2,K3``. Raises BadInput."""
    import numpy as np

    expected = "K1,K2 in A/A and A s/rad, or K1,K2,K3 with the integral gain in A/rad, all finite"
    try:
        gains = [float(part) for part in text.split(",")]
    except ValueError:
        raise BadInput("--gain", "", text, expected) from None
    if len(gains) not in (2, 3) or not all(map(math.isfinite, gains)):
        raise BadInput("--gain", "", text, expected)
    return np.array(gains)
