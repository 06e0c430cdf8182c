"""``hil reproduce ling2012``: the paper's figures beside ours."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.terminal.exit_status import reported_errors
from hil.terminal.options import JsonOption
from hil.terminal.output import print_figures, put, say_written

if TYPE_CHECKING:
    from rich.console import Console


def ling2012(
    figures: Annotated[
        Path | None,
        typer.Option("--figures", metavar="DIR", help="Folder for the pictures, and for the recorded runs."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """[Ling2012] in full: Table 2 by every method, the printed controller, and Cases 1 to 3 on the bench."""
    with reported_errors():
        from drivers.timebase import utc_stamp
        from hil.studies.papers.reproduction import reproduce

        runs = (figures or Path("runs")) / f"ling2012-{utc_stamp()}"
        found, recorded = reproduce(runs, lambda text: typer.echo(text, err=True))
        if figures is not None:
            from hil.studies.papers.pictures import draw_ling2012

            for path in draw_ling2012(found, recorded, figures):
                say_written(path)
        put(found, as_json, _print)


def _print(found: dict[str, Any]) -> None:
    from rich.console import Console

    from design.papers.ling2012 import DISAGREEMENTS

    console = Console(highlight=False)
    for units, title in (("published", "in the paper's units"), ("si", "in SI")):
        _print_table(console, found["table2"][units], title)
    console.print("Controller of section 5")
    print_figures(found["published_design"], "  ")
    for case in ("case1", "case2", "case3"):
        console.print(case.replace("case", "Case "))
        print_figures(found[case], "  ")
    console.print("Strategies on 10 ms, 5 losses in a row, 4 ms of delay, K as printed")
    for name, item in found["strategies"].items():
        shown = ("sequences", "age_max_s")
        print_figures({name: {key: item[key] for key in shown}}, "  ")
    for text in DISAGREEMENTS:
        console.print(f"* {text}")


def _print_table(console: "Console", rows: list[dict[str, Any]], title: str) -> None:
    from rich.table import Table

    table = Table(title=f"Table 2 {title}: largest delay, ms", title_justify="left")
    columns = {
        "published_delay_s": "printed",
        "ccl_delay_s": "CCL",
        "lmi_delay_s": "LMI",
        "exact_speed_feedback_delay_s": "exact, speed only",
        "exact_delay_s": "exact, full",
    }
    for heading in ("error, %", "gamma", *columns.values(), "K, full"):
        table.add_column(heading, justify="right")
    for row in rows:
        delays = [f"{1e3 * row[key]:.4g}" for key in columns]
        gain = ", ".join(f"{value:.4g}" for value in row["gain"])
        table.add_row(f"{row['error_percent']:g}", f"{row['gamma']:.5g}", *delays, gain)
    console.print(table)
