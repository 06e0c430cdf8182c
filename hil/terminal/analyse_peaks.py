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
    load_nm: LoadOption = None
    as_json: JsonOption = False


def peaks(asked: PeaksOptions) -> None:
    """Bound the speed error after a load step, whichever readings and commands are lost.

    A row for each number of losses in a row, up to those asked for. Certified: no sequence exceeds it, at any
    instant, whenever the load comes, with any inertia of a range as --inertia-percent 70,130. Found: some
    sequence reaches it. The rest of motor and drive is what the controller was made for, and so are the
    delays.

    Examples:
      hil analyse peaks examples/controllers/ling2012-fused.toml --losses-max 1
    """
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
    )
    put(figures, asked.as_json, print_figures)


def _inertias(text: str) -> tuple[float, float]:
    """Return the ends of a range, as multiples. Raises BadInput."""
    expected = "LEAST,MOST in percent, from 1 to 10000, as in 70,130"
    try:
        least, most = (0.01 * float(part) for part in text.split(","))
    except ValueError:
        raise BadInput("--inertia-percent", "", text, expected) from None
    if not 0.01 <= least <= most <= 100.0:
        raise BadInput("--inertia-percent", "", text, expected)
    return least, most
