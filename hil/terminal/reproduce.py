"""``hil reproduce``: the figures of both papers, published and reproduced."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servobench.hil.terminal.options import JsonOption, motor_file, valued
from servobench.hil.terminal.output import print_figures, put, say_written

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def azaiz2007(
    figures: Annotated[
        Path | None, valued("--figures", "DIR", "Folder for the pictures, Figs. 7 to 13.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Reproduce [Azaiz2007]: both current controllers, their margins, and the drive of Fig. 4.

    Examples:
      hil reproduce azaiz2007 --figures figures
    """
    from servobench.design.papers.azaiz2007 import reproduce

    results, designs, runs = reproduce()
    if figures is not None:
        from servobench.hil.studies.current.pictures import draw_paper

        for path in draw_paper(designs, runs, figures):
            say_written(path)
    put(results, as_json, _print_azaiz2007)


def _print_azaiz2007(figures: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    from servobench.design.papers.azaiz2007 import DISAGREEMENTS, PUBLISHED

    console = Console()
    for axis in ("q", "d"):
        console.print(_controller_table(axis, figures[axis]))
    peak = PUBLISHED["simulation"]["peak_torque_nm"]
    table = Table(title=f"The drive of Fig. 4 (published peak torque: {peak:g} N m)", title_justify="left")
    table.add_column("figure")
    for name in figures["simulation"]:
        table.add_column(name.replace("_", " "))
    for key in figures["simulation"]["nominal"]:
        table.add_row(key, *(f"{run[key]:.5g}" for run in figures["simulation"].values()))
    console.print(table)
    for text in DISAGREEMENTS:
        console.print(f"* {text}", highlight=False)


def _controller_table(axis: str, figures: dict[str, Any]) -> "Table":
    """Tabulate published values, those of the printed controller on the printed plant, and ours."""
    from rich.table import Table

    from servobench.design.papers.azaiz2007 import PUBLISHED, printed_figures

    table = Table(title=f"K_{axis}", title_justify="left")
    for heading in ("figure", "published", "printed K", "here"):
        table.add_column(heading)
    printed = printed_figures(axis)
    for key, value in figures.items():
        if isinstance(value, float):
            published = PUBLISHED[axis].get(key)
            shown = "" if published is None else f"{published:g}"
            # gamma_min is the problem's, whatever the controller
            beside = "" if key == "gamma_min" else f"{printed[key]:.6g}"
            table.add_row(key, shown, beside, f"{value:.6g}")
        elif isinstance(value, list):
            table.add_row(key, "", _listed(printed[key]), _listed(value))
    for key, value in figures["reduced"].items():
        table.add_row(f"reduced {key}", "", "", _listed(value) if isinstance(value, list) else f"{value:.6g}")
    return table


def _listed(values: list[Any]) -> str:
    from servobench.hil.terminal.current_report import root_text

    return "\n".join(root_text(value) if isinstance(value, list) else f"{value:.5g}" for value in values)


def ling2012(
    motor: Annotated[
        Path | None, valued("--motor", "MOTOR.toml", "Only Table 2, for your own motor.")
    ] = None,
    figures: Annotated[
        Path | None, valued("--figures", "DIR", "Folder for the pictures, and for the recorded runs.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Reproduce [Ling2012]: Table 2 by every method, the printed controller, and Cases 1 to 3 on the
    bench.

    Examples:
      hil reproduce ling2012 --figures figures   # some minutes
    """
    if motor is not None:
        _for_motor(motor, figures, as_json)
        return
    from servobench.drivers.timebase import utc_stamp
    from servobench.hil.studies.papers.reproduction import reproduce

    runs = (figures or Path("runs")) / f"ling2012-{utc_stamp()}"
    results, recorded = reproduce(runs, lambda text: typer.echo(text, err=True))
    if figures is not None:
        from servobench.hil.studies.papers.pictures import draw_ling2012

        for path in draw_ling2012(results, recorded, figures):
            say_written(path)
    put(results, as_json, _print_ling2012)


def _for_motor(motor: Path, figures: Path | None, as_json: bool) -> None:
    from servobench.hil.studies.papers.reproduction import for_motor

    results = for_motor(motor_file(motor, "--motor").parameters)
    if figures is not None:
        from servobench.hil.studies.drawing import draw_all
        from servobench.hil.studies.papers.pictures import draw_motor

        for path in draw_all(figures, {f"{motor.stem}-table2.png": lambda path: draw_motor(results, path)}):
            say_written(path)
    put(results, as_json, _print_motor)


def _print_motor(figures: dict[str, Any]) -> None:
    from rich.console import Console

    console = Console(highlight=False)
    load = f"load step of {figures['load_nm']:.4g} N m at {figures['speed_rpm']:.5g} r/min"
    _print_table(
        console,
        [row for row in figures["rows"] if "impossible" not in row],
        f"for {figures['motor']}, {load}",
    )
    for row in figures["rows"]:
        if "impossible" in row:
            console.print(f"* {row['error_percent']:g} %: {row['impossible']}")


def _print_ling2012(figures: dict[str, Any]) -> None:
    from rich.console import Console

    from servobench.design.papers.ling2012 import DISAGREEMENTS

    console = Console(highlight=False)
    for units, title in (("published", "in the paper's units"), ("si", "in SI")):
        _print_table(console, figures["table2"][units], title)
    console.print("Controller of section 5")
    print_figures(figures["published_design"], "  ")
    for case in ("case1", "case2", "case3"):
        console.print(case.replace("case", "Case "))
        print_figures(figures[case], "  ")
    console.print("Strategies on 10 ms, 5 losses in a row, 4 ms of delay, K as printed")
    for name, item in figures["strategies"].items():
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
    columns = {key: heading for key, heading in columns.items() if all(key in row for row in rows)}
    for heading in ("error, %", "gamma", *columns.values(), "K, full"):
        table.add_column(heading, justify="right")
    for row in rows:
        delays = ["-" if row[key] is None else f"{1e3 * row[key]:.4g}" for key in columns]
        gain = ", ".join(f"{value:.4g}" for value in row["gain"])
        table.add_row(f"{row['error_percent']:g}", f"{row['gamma']:.5g}", *delays, gain)
    console.print(table)
