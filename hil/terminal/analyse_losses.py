"""``hil analyse losses``: a designed controller on a network that loses frames at random."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import JsonOption, valued
from servobench.hil.terminal.output import print_figures, put

DESIGNED = ("state_feedback", "predictor", "fused", "hinf")
LoadOption = Annotated[
    float | None, valued("--load-nm", "T", "Load step; default: that of the design, or 1 N m.", min=1e-9)
]


@dataclass(frozen=True, slots=True, kw_only=True)
class LossesOptions:
    """Options of ``hil analyse losses``."""

    controller: Annotated[
        Path, typer.Argument(metavar="CONTROLLER.toml", help="A controller that hil design speed wrote.")
    ]
    network: Annotated[
        Path, valued("--network", "NETWORK.toml", "Network file with the losses, as hil measure writes it.")
    ]
    load_nm: LoadOption = None
    threshold_rad_s: Annotated[
        list[float] | None,
        valued("--threshold-rad-s", "W", "Speed error to exceed; may be repeated.", min=1e-9),
    ] = None
    as_json: JsonOption = False


def losses(asked: LossesOptions) -> None:
    """Compute what random losses do: decay in mean square, spread after a load step, chance to exceed.

    Losses are those of the network file, independent or in bursts; delays and motor those that the controller
    was made for. The load comes just after a sample.

    Examples:
      hil analyse losses examples/controllers/ling2012-fused.toml --network n.toml
    """
    from servobench.hil.configuration.bench_file import load_controller
    from servobench.hil.configuration.network_file import commands_unknown, load_network
    from servobench.hil.studies.speed.random_losses import Designed, losses_figures, losses_of

    controller, network = load_controller(asked.controller), load_network(asked.network)
    if not isinstance(controller, Designed):
        kind = getattr(controller, "kind", "")
        raise BadInput(str(asked.controller), "controller.kind", kind, f"one of {', '.join(DESIGNED)}")
    if unknown := commands_unknown(network, str(asked.network)):
        raise unknown
    figures = losses_figures(
        controller,
        asked.controller,
        losses_of(network, asked.network, controller),
        asked.load_nm,
        asked.threshold_rad_s or [],
    )
    put(figures, asked.as_json, _show)


def _show(figures: dict[str, Any]) -> None:
    """Print all but the courses over time."""
    step = figures["after_step"]
    short = step and {key: value for key, value in step.items() if not isinstance(value, list)}
    print_figures(figures | {"after_step": short})
