"""``hil design hinf``: H-infinity synthesis for your own plant."""

from pathlib import Path
from typing import Annotated, Any

import typer

from servobench.hil.terminal.options import JsonOption, gamma_option, valued
from servobench.hil.terminal.output import put


def hinf(
    plant: Annotated[
        Path, typer.Argument(metavar="PLANT.toml", help="A, B, C, D, controls, measurements; TOML or JSON.")
    ],
    gamma: Annotated[float | None, gamma_option(1e-12)] = None,
    gamma_factor: Annotated[
        float, valued("--gamma-factor", None, "Without --gamma: multiple of gamma_min.", min=1.0)
    ] = 1.1,
    as_json: JsonOption = False,
) -> None:
    r"""Compute the central controller of x' = A x + B \[w; u], \[z; y] = C x + D \[w; u] for ||z/w|| <
    gamma.

    Examples:
      hil design hinf plant.toml   # a plant of your own
    """
    from servobench.design.hinf.synthesis import gamma_min, synthesise, verified_norm
    from servobench.hil.configuration.design_files import load_plant
    from servobench.hil.terminal.current_report import print_current, refused

    loaded = load_plant(plant)
    with refused(str(plant)):
        least = gamma_min(loaded)
        synthesis = synthesise(loaded, gamma if gamma is not None else gamma_factor * least)
    K = synthesis.controller  # noqa: N806 - the paper's letter
    figures: dict[str, Any] = {
        "gamma_min": least,
        "gamma": synthesis.gamma,
        "closed_loop_norm": verified_norm(loaded, K),
        "controller": {name: getattr(K, name).tolist() for name in "ABCD"},
    }

    def show(_figures: dict[str, Any]) -> None:
        matrices = figures.pop("controller")
        print_current(figures)
        for name, rows in matrices.items():
            for k, row in enumerate(rows):
                typer.echo(f"{name if k == 0 else '':<3} {'  '.join(f'{value:.6g}' for value in row)}")

    put(figures, as_json, show)
