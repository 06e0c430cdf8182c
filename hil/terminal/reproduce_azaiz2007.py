"""``hil reproduce azaiz2007``: the paper's figures beside ours."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.terminal.exit_status import reported_errors


def azaiz2007(
    figures: Annotated[
        Path | None, typer.Option("--figures", metavar="DIR", help="Folder for the pictures, Figs. 7 to 13.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object on stdout, all else on stderr.")
    ] = False,
) -> None:
    """[Azaiz2007] in full: both current controllers, their margins, and the drive of Fig. 4."""
    with reported_errors():
        from design.papers.azaiz2007 import reproduce

        found, designs, runs = reproduce()
        if figures is not None:
            from hil.figures.current_loops import draw_paper

            for path in draw_paper(designs, runs, figures):
                typer.echo(f"written {path}", err=True)
        if as_json:
            typer.echo(json.dumps(found, allow_nan=False))
        else:
            _print(found)


def _print(found: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    from design.papers.azaiz2007 import DISAGREEMENTS, PUBLISHED

    console = Console()
    for axis in ("q", "d"):
        table = Table(title=f"K_{axis}", title_justify="left")
        for heading in ("figure", "published", "here"):
            table.add_column(heading)
        for key, value in found[axis].items():
            if isinstance(value, float):
                published = PUBLISHED[axis].get(key)
                table.add_row(key, "" if published is None else f"{published:g}", f"{value:.6g}")
        console.print(table)
    table = Table(title="The drive of Fig. 4 (published peak torque: 14.3 N m)", title_justify="left")
    table.add_column("figure")
    for name in found["simulation"]:
        table.add_column(name.replace("_", " "))
    for key in found["simulation"]["nominal"]:
        table.add_row(key, *(f"{run[key]:.5g}" for run in found["simulation"].values()))
    console.print(table)
    for text in DISAGREEMENTS:
        console.print(f"* {text}")
