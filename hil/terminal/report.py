"""The summary of a run, for the terminal."""

import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from servobench.hil.configuration.config import BenchConfig
from servobench.hil.machine.extras import is_installed
from servobench.hil.machine.parent_process import results
from servobench.hil.terminal.output import columns, titled
from servobench.hil.terminal.why import brief_lines
from servobench.hil.verdict.figures import Percentiles
from servobench.hil.verdict.limits import metric_title
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.summary_text import certificate_lines, computing_note, loss_text, timing_lines
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
    error, dropouts, axes = summary.speed_error, summary.dropouts, len(config.axes)
    rows = summary.cycles * axes
    share = f" ({100.0 * dropouts.total / rows:.2f} %)" if rows else ""
    lines = {
        "Run": f"{summary.cycles} cycles at {1e6 / config.loop.period_us:g} Hz, "
        f"{axes} {'axis' if axes == 1 else 'axes'}, bus {bus_spec or config.bus.spec}, seed {summary.seed}",
        "Tracking error": f"peak {_number(error.peak_rad_s)} rad/s ({_number(error.peak_percent)} %), "
        f"rms {_number(error.rms_rad_s)} rad/s",
        "After load step": f"{_number(error.after_load_percent)} % at most"
        if error.after_load_percent is not None
        else "not measured",
        "Torque": f"{_number(summary.torque_rms_nm)} N m rms about its mean while reference and load stay"
        if summary.torque_rms_nm is not None
        else "never steady for long enough to be judged",
        "Reading delay": _percentiles(summary.reading_delay_us),
        "Action delay": _percentiles(summary.action_delay_us),
        "Lateness": _percentiles(summary.lateness_us),
        "Computing": _percentiles(summary.compute_us),
        "Dropouts": f"{dropouts.total}{share}: "
        f"{dropouts.lost} lost, {dropouts.late} late, {dropouts.stale} stale, {dropouts.missed} missed",
        "Lost in a row": loss_text(summary),
        **timing_lines(summary.timing),
        **certificate_lines(summary.certificates),
        **({"Load machine": _load_machine(summary.load_machine)} if summary.load_machine else {}),
        "Bus load": f"{_number(summary.bus_load_percent)} %",
        "Pace": f"{_number(summary.realtime_factor)} times real time",
        "Digest": summary.digest,
    }
    return titled(lines)


def _load_machine(machine: Mapping[str, Any]) -> str:
    steps = [
        f"{step['asked_nm']:g} N m asked, {_number(step['measured_nm'])} measured"
        for step in machine["steps"]
    ]
    counts = f"{machine['readings']} readings, {machine['late']} late, {machine['spoilt']} spoilt"
    return "; ".join([*steps, counts])


def _verdict_table(summary: Summary) -> Table | Text:
    if not summary.verdict.limits:
        return Text("The bench file sets no limits in [verdict].", style="yellow")
    table = columns("Verdict", "value", "limit", "", right=("value", "limit"))
    for check in summary.verdict.limits:
        title, mark = Text(metric_title(check.metric)), Text(*_MARKS[check.result])
        table.add_row(title, _number(check.value), f"{check.limit:g}", mark)
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


def _percentiles(of: Percentiles) -> str:
    return f"p50 {_number(of.p50)} us, p99 {_number(of.p99)} us, max {_number(of.max)} us"


def _number(value: float | None) -> str:
    """Format three significant digits, whole numbers in full; a dash for an unmeasured value."""
    if value is None:
        return "-"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


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
