"""``hil analyse peaks``: the largest error after a load step, over every sequence of losses."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.analyse_losses import DESIGNED, LoadOption
from servobench.hil.terminal.options import JsonOption, valued
from servobench.hil.terminal.output import print_figures, put


@dataclass(frozen=True, slots=True, kw_only=True)
class PeaksOptions:
    """Options of ``hil analyse peaks``."""

    controller: Annotated[
        Path, typer.Argument(metavar="CONTROLLER.toml", help="A controller that hil design speed wrote.")
    ]
    losses_max: Annotated[
        int, valued("--losses-max", "N", "Readings lost in a row, at most.", min=0, max=5)
    ] = 1
    command_losses_max: Annotated[
        int, valued("--command-losses-max", "N", "Commands lost in a row, at most.", min=0, max=2)
    ] = 0
    inertia_percent: Annotated[
        str,
        valued("--inertia-percent", "LEAST,MOST", "Inertias, of the one that the controller was made for."),
    ] = "100,100"
    delay_ms: Annotated[
        str | None,
        valued("--delay-ms", "LEAST,MOST", "Sample to action, dead time of the drive included."),
    ] = None
    decay: Annotated[
        bool, typer.Option("--decay", help="The slowest decay over the same sequences as well.")
    ] = False
    gain: Annotated[
        bool, typer.Option("--gain", help="The gain from load to speed over the same sequences as well.")
    ] = False
    load_nm: LoadOption = None
    as_json: JsonOption = False


def peaks(asked: PeaksOptions) -> None:
    """Bound the speed error after a load step, whichever readings and commands are lost.

    A row for each number of losses in a row, up to those asked for. Certified: no sequence exceeds it, at any
    instant, whenever the load comes, with any inertia of a range as --inertia-percent 70,130, and with any
    delay of a range as --delay-ms 1,1.3, another one in each period. Found: some sequence reaches it. The
    rest of motor and drive is what the controller was made for. A static gain that applies samples as they
    arrive has any delay up to the largest of its network.

    --decay bounds how slowly the loop comes to rest, over the same sequences, inertias and delays; --gain
    the L2 gain from load torque to speed error, but over delays that vary, and for a predictor over lost
    commands and inertias, which no certificate of it covers.

    Examples:
      hil analyse peaks examples/controllers/ling2012-fused.toml --losses-max 1
    """
    from servobench.design.sampled.varying_delay import DelayRange
    from servobench.hil.configuration.bench_file import load_controller
    from servobench.hil.studies.speed.loss_peaks import peaks_figures
    from servobench.hil.studies.speed.random_losses import Designed

    controller = load_controller(asked.controller)
    if not isinstance(controller, Designed):
        kind = getattr(controller, "kind", "")
        raise BadInput(str(asked.controller), "controller.kind", kind, f"one of {', '.join(DESIGNED)}")
    figures = peaks_figures(
        controller,
        asked.controller,
        asked.losses_max,
        asked.command_losses_max,
        asked.load_nm,
        _inertias(asked.inertia_percent),
        None if asked.delay_ms is None else DelayRange(*_delays_s(asked.delay_ms)),
        decay=asked.decay,
        gain=asked.gain,
    )
    put(figures, asked.as_json, print_figures)


def _inertias(text: str) -> tuple[float, float]:
    """Return the ends of a range, as multiples. Raises BadInput."""
    expected = "LEAST,MOST in percent, from 1 to 10000, as in 70,130"
    least, most = (0.01 * each for each in _range("--inertia-percent", text, expected))
    if not 0.01 <= least <= most <= 100.0:
        raise BadInput("--inertia-percent", "", text, expected)
    return least, most


def _delays_s(text: str) -> tuple[float, float]:
    expected = "LEAST,MOST in milliseconds, from 0 to 1000, as in 0.7,1"
    least, most = (1e-3 * each for each in _range("--delay-ms", text, expected))
    if not 0.0 <= least <= most <= 1.0:
        raise BadInput("--delay-ms", "", text, expected)
    return least, most


def _range(option: str, text: str, expected: str) -> tuple[float, float]:
    try:
        least, most = map(float, text.split(","))
    except ValueError:
        raise BadInput(option, "", text, expected) from None
    return least, most
