"""``hil design speed --structure predictor`` and ``hinf``: their options, and what they print and write."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from drivers.errors import MISSING, BadInput
from hil.terminal.output import on_terminal, print_figures, put, say_written

if TYPE_CHECKING:
    from design.motor import PmsmParameters
    from design.sampled.held_loop import SampledNetwork
    from hil.configuration.drive_current_loop import KnownLoop

_PERIOD_MS = 1.0
"""That of a bench which says nothing of it."""
_NOISE_SHARE = 0.05
"""Of the rated torque."""
_LOSSES, _LOSSES_MAX = 1, 5
"""In a row. The certificate goes over every sequence of them: of 20, as an outage leaves them in a network
file, it had not ended after 15 minutes, at 10 GB."""

PeriodMsOption = Annotated[
    float | None,
    typer.Option(
        "--period-ms",
        metavar="H",
        min=0.05,
        help="Predictor, hinf: of the loop, with --delay-ms; 1 if absent.",
    ),
]
EncoderCountsOption = Annotated[
    int | None,
    typer.Option(
        "--encoder-counts",
        metavar="N",
        min=16,
        help="Predictor, hinf: a revolution of the encoder; else 65536.",
    ),
]
SpeedFilterOption = Annotated[
    float | None,
    typer.Option(
        "--speed-filter-hz",
        metavar="F",
        min=1.0,
        help="Predictor, hinf: of the filter behind 606Ch; 500, as the simulated drive has it, if absent.",
    ),
]
DeadTimeOption = Annotated[
    float | None,
    typer.Option(
        "--drive-dead-time-us",
        metavar="D",
        min=0.0,
        help="Predictor, hinf: of the drive, beside its current loop; 100, the simulated drive's, if absent.",
    ),
]
TorqueNoiseOption = Annotated[
    float | None,
    typer.Option(
        "--torque-noise-nm",
        metavar="T",
        min=1e-9,
        help="Predictor, hinf: what the encoder may make of the torque, rms; 5 % of the rated if absent.",
    ),
]

LossesMaxOption = Annotated[
    int | None,
    typer.Option(
        "--losses-max",
        metavar="N",
        min=0,
        max=_LOSSES_MAX,
        help="Predictor, hinf: samples lost in a row that are certified, with --delay-ms; 1 if absent.",
    ),
]


class PredictorOptions(NamedTuple):
    """As given; None: not."""

    period_ms: float | None
    encoder_counts: int | None
    speed_filter_hz: float | None
    drive_dead_time_us: float | None
    torque_noise_nm: float | None
    losses_max: int | None

    @property
    def given(self) -> dict[str, object]:
        """By option."""
        return {f"--{name.replace('_', '-')}": value for name, value in self._asdict().items()}


def refuse_given(options: Mapping[str, object], expected: str) -> None:
    """Raises BadInput for the first option that is given."""
    for option, value in options.items():
        if value is not None:
            raise BadInput(option, "", value, expected)


def finish_predictor(
    structure: str,
    motor: "PmsmParameters",
    inner: "KnownLoop",
    options: PredictorOptions,
    delay_s: float | None,
    network: "SampledNetwork | None",
    load_nm: float | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Design it, a ``predictor`` or ``hinf``, print the figures and write the file. Raises BadInput."""
    from design.errors import DesignError
    from drivers.bounded_file import write_file
    from hil.studies.speed.controller_text import controller_text
    from hil.studies.speed.dynamic import (
        DEAD_TIME_US,
        ENCODER_COUNTS,
        SPEED_FILTER_HZ,
        design_speed_hinf,
        design_speed_predictor,
        request_of,
    )

    dead_time_us = options.drive_dead_time_us
    period_s, delay_max_s, losses_max = _network(options, delay_s, network)
    request = request_of(
        motor,
        inner.bandwidth_hz,
        period_s,
        delay_max_s,
        load_nm or motor.rated_torque_nm,
        options.torque_noise_nm or _NOISE_SHARE * motor.rated_torque_nm,
        encoder_counts=options.encoder_counts or ENCODER_COUNTS,
        speed_filter_hz=options.speed_filter_hz or SPEED_FILTER_HZ,
        dead_time_us=DEAD_TIME_US if dead_time_us is None else dead_time_us,
    )
    design = design_speed_hinf if structure == "hinf" else design_speed_predictor
    on_terminal("gain and decay over every sequence of lost samples: some s, at long delays minutes")
    try:
        made = design(request, losses_max, network is not None).certified()
    except DesignError as error:
        raise BadInput("hil design speed", "", str(error), "a design that exists") from error
    put({"current_bandwidth_from": inner.key, **made.figures}, as_json, print_figures)
    if out is not None:
        write_file("--out", out, controller_text(made.controller()))
        say_written(out)


def _network(
    options: PredictorOptions, delay_s: float | None, network: "SampledNetwork | None"
) -> tuple[float, float, int]:
    """The period, s, the delay from a sample to its command's instant, s, and the losses in a row.

    ``delay_s``: the age that a sample reaches, period included, as elsewhere in this command.
    """
    if network is not None:
        own = {"--period-ms": options.period_ms, "--losses-max": options.losses_max}
        for option, value in {"--delay-ms": delay_s, **own}.items():
            if value is not None:
                raise BadInput(option, "", value, f"either --network or {option}")
        if network.losses_max > _LOSSES_MAX:
            remedy = "give --delay-ms, --period-ms and --losses-max: a run in which more are lost tells so"
            expected = f"at most {_LOSSES_MAX} in all"
            raise BadInput("--network", "network.losses_in_a_row_max", network.losses_max, expected, remedy)
        return network.period_s, network.delay_max_s, network.losses_max
    period_s = 1e-3 * (options.period_ms or _PERIOD_MS)
    if delay_s is None or delay_s < period_s:
        least = f"at least a period of {1e3 * period_s:g} ms, or --network"
        raise BadInput("--delay-ms", "", MISSING if delay_s is None else 1e3 * delay_s, least)
    return period_s, delay_s - period_s, _LOSSES if options.losses_max is None else options.losses_max
