"""The summary of a run, for the terminal."""

import shutil
import sys
from pathlib import Path

from rich.console import Console, Group
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from servobench.hil.configuration.config import BenchConfig
from servobench.hil.machine.extras import is_installed
from servobench.hil.machine.parent_process import results
from servobench.hil.terminal.output import columns, titled
from servobench.hil.terminal.why import brief_lines
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.summary_text import certificate_lines, computing_note, limit_rows, summary_lines
from servobench.hil.verdict.verdict import LimitResult, VerdictKind, verdict_title

WIDTH_MAX = 100
_STYLE = {VerdictKind.PASSED: "green", VerdictKind.NOTHING_ASKED: "yellow"}
_TOLD_ELSEWHERE = (VerdictKind.NOT_PASSED, VerdictKind.NOT_RECORDED)
"""Verdicts explained elsewhere: in the table of limits, and in the recording's faults."""
_MARKS = {
    LimitResult.KEPT: ("ok", "green"),
    LimitResult.BROKEN: ("too high", "bold red"),
    LimitResult.NOT_MEASURED: ("not measured", "bold red"),
}


def print_run(
    config: BenchConfig,
    summary: Summary,
    *,
    bus_spec: str | None = None,
    console: Console | None = None,
) -> None:
    """Print one screen: the run, its figures, the verdict, and the recording's place."""
    console = console or Console(highlight=False, file=results())
    panel = Panel(
        Group(_figures(config, summary, bus_spec), Text(), _verdict_table(summary), *_notes(config, summary)),
        title=Text(f"{config.bench.name}: {verdict_title(summary.verdict)}", style="bold"),
        title_align="left",
        border_style=_STYLE.get(summary.verdict.outcome, "red"),
        width=min(console.width, WIDTH_MAX),
        padding=(0, 1),
    )
    console.print(panel)
    for line in recording_lines(summary.recording):
        console.print(Text(line), soft_wrap=True)
    for line in brief_lines(summary):
        console.print(Text(line), soft_wrap=True)


def _figures(config: BenchConfig, summary: Summary, bus_spec: str | None) -> Table:
    axes = len(config.axes)
    begun = (
        f"{summary.cycles} cycles at {1e6 / config.loop.period_us:g} Hz, "
        f"{axes} {'axis' if axes == 1 else 'axes'}, bus {bus_spec or config.bus.spec}, seed {summary.seed}"
    )
    return titled({"Run": begun, **summary_lines(summary, axes), **certificate_lines(summary.certificates)})


def _verdict_table(summary: Summary) -> Table | Text:
    if not summary.verdict.limits:
        return Text("The bench file sets no limits in [verdict].", style="yellow")
    table = columns("Verdict", "value", "limit", "", right=("value", "limit"))
    for title, value, limit, result, _ in limit_rows(summary.verdict.limits):
        table.add_row(Text(title), value, limit, Text(*_MARKS[LimitResult(result)]))
    return table


def _notes(config: BenchConfig, summary: Summary) -> list[Text]:
    notes = []
    for finding in summary.verdict.findings:
        if finding.outcome not in _TOLD_ELSEWHERE:
            notes.append(Text(f"{finding.outcome.capitalize()}: {finding.text}", style="bold red"))
    slow = computing_note(summary, config.loop.period_us)
    told = [*summary.network_notes, *([slow.capitalize()] if slow else [])]
    notes.extend(Text(note, style="bold yellow") for note in told)
    notes.extend(Text(f"The recording lacks: {fault}", style="yellow") for fault in summary.recording_faults)
    return notes


def recording_lines(folder: str) -> list[str]:
    """Return the recording's place and the command that opens it; ``folder``: empty if there is none."""
    if not folder:
        return ["Recording  none requested"]
    if not is_installed("rerun"):
        return [f"Recording  {_shortest(Path(folder))}"]
    place = _shortest(Path(folder) / "run.rrd")
    return [f"Recording  {place}", f"Open with  {viewer_command()} {place}"]


def viewer_command() -> str:
    """Return the Rerun viewer: by name if it is on the PATH, else the one beside this interpreter."""
    beside = Path(sys.executable).parent / "rerun"
    if shutil.which("rerun") or not beside.exists():
        return "rerun"
    return _shortest(beside)


def _shortest(path: Path) -> str:
    """Return the path relative to the working directory if it lies below."""
    absolute = path.absolute()
    working = Path.cwd()
    return str(absolute.relative_to(working)) if absolute.is_relative_to(working) else str(path)
