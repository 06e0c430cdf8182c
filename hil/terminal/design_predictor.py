"""``hil design speed --structure predictor`` and ``hinf``: their options, and their design."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated

from servobench.drivers.errors import MISSING, BadInput
from servobench.hil.terminal.options import given, valued
from servobench.hil.terminal.output import on_terminal

if TYPE_CHECKING:
    from servobench.design.motor import PmsmParameters
    from servobench.design.sampled.held_loop import SampledNetwork
    from servobench.hil.studies.speed.dynamic import DynamicResult

_PERIOD_MS = 1.0
"""The default period of a bench."""
_NOISE_SHARE = 0.05
"""Share of the rated torque."""
_LOSSES, _LOSSES_MAX = 1, 5
"""Losses in a row. The certificate covers every sequence of them: for 20, as an outage leaves them in a
network file, it had not ended after 15 minutes, at 10 GB."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictorOptions:
    """Options of these structures alone."""

    period_ms: Annotated[
        float | None,
        valued(
            "--period-ms", "H", "Predictor, hinf: period of the loop, with --delay-ms; default: 1.", min=0.05
        ),
    ] = None
    encoder_counts: Annotated[
        int | None,
        valued(
            "--encoder-counts", "N", "Predictor, hinf: encoder counts per revolution; default: 65536.", min=16
        ),
    ] = None
    speed_filter_hz: Annotated[
        float | None,
        valued(
            "--speed-filter-hz",
            "F",
            "Predictor, hinf: bandwidth of the filter behind 606Ch; default: the simulated drive's 500.",
            min=1.0,
        ),
    ] = None
    drive_dead_time_us: Annotated[
        float | None,
        valued(
            "--drive-dead-time-us",
            "D",
            "Predictor, hinf: dead time of the drive, without its current loop; default: 100.",
            min=0.0,
        ),
    ] = None
    torque_noise_nm: Annotated[
        float | None,
        valued(
            "--torque-noise-nm",
            "T",
            "Predictor, hinf: torque noise from the encoder, rms; default: 5 % of rated.",
            min=1e-9,
        ),
    ] = None
    sampling_jitter_us: Annotated[
        float | None,
        valued(
            "--sampling-jitter-us",
            "J",
            "Fused: rms by which the instant of a sample is unsure, at rated speed; default: 0.",
            min=0.0,
        ),
    ] = None
    losses_max: Annotated[
        int | None,
        valued(
            "--losses-max",
            "N",
            "Predictor, hinf: consecutive lost samples to certify, with --delay-ms; default: 1.",
            min=0,
            max=_LOSSES_MAX,
        ),
    ] = None

    @property
    def given(self) -> dict[str, object]:
        """The options given, by name."""
        return given(self, *(each.name for each in fields(self)))


def design_dynamic(
    structure: str,
    options: PredictorOptions,
    motor: "PmsmParameters",
    current_bandwidth_hz: float,
    delay_ms: float | None,
    network: "SampledNetwork | None",
    load_nm: float | None,
    uneven_s: float = 0.0,
) -> "DynamicResult":
    """Design a ``predictor`` or ``hinf``, with its certificate. Raises BadInput."""
    from servobench.design.errors import DesignError
    from servobench.hil.studies.speed.dynamic import (
        DEAD_TIME_US,
        ENCODER_COUNTS,
        SPEED_FILTER_HZ,
        design_speed_hinf,
        design_speed_predictor,
        request_of,
    )
    from servobench.hil.studies.speed.fused import design_speed_fused, fused_request

    dead_time_us = options.drive_dead_time_us
    period_s, delay_max_s, losses_max = _network(options, delay_ms, network)
    request = request_of(
        motor,
        current_bandwidth_hz,
        period_s,
        delay_max_s,
        load_nm or motor.rated_torque_nm,
        options.torque_noise_nm or _NOISE_SHARE * motor.rated_torque_nm,
        encoder_counts=options.encoder_counts or ENCODER_COUNTS,
        speed_filter_hz=options.speed_filter_hz or SPEED_FILTER_HZ,
        dead_time_us=DEAD_TIME_US if dead_time_us is None else dead_time_us,
        uneven_s=uneven_s,
    )
    measured = network is not None
    on_terminal("gain and decay over every sequence of lost samples: some s, at long delays minutes")
    try:
        if structure == "fused":
            jitter_us = options.sampling_jitter_us or 0.0
            asked = fused_request(request, options.encoder_counts or ENCODER_COUNTS, jitter_us)
            return design_speed_fused(asked, losses_max, measured).certified()
        design = design_speed_hinf if structure == "hinf" else design_speed_predictor
        return design(request, losses_max, measured).certified()
    except DesignError as error:
        raise BadInput("hil design speed", "", str(error), "a design that exists") from error


def _network(
    options: PredictorOptions, delay_ms: float | None, network: "SampledNetwork | None"
) -> tuple[float, float, int]:
    """Return the period, s, the delay from a sample to its command's instant, s, and the losses in a row.

    ``delay_ms``: the age that a sample reaches, period included, as elsewhere in this command.
    """
    if network is not None:
        others = {} if delay_ms is None else {"--delay-ms": delay_ms}
        for option, value in (others | given(options, "period_ms", "losses_max")).items():
            raise BadInput(option, "", value, f"either --network or {option}")
        if network.losses_max > _LOSSES_MAX:
            remedy = "give --delay-ms, --period-ms and --losses-max: a run in which more are lost tells so"
            expected = f"at most {_LOSSES_MAX} in all"
            raise BadInput("--network", "network.losses_in_a_row_max", network.losses_max, expected, remedy)
        return network.period_s, network.delay_max_s, network.losses_max
    period_ms = options.period_ms or _PERIOD_MS
    if delay_ms is None or delay_ms < period_ms:
        least = f"at least a period of {period_ms:g} ms, or --network"
        raise BadInput("--delay-ms", "", MISSING if delay_ms is None else delay_ms, least)
    period_s, losses = 1e-3 * period_ms, options.losses_max
    return period_s, 1e-3 * delay_ms - period_s, _LOSSES if losses is None else losses
