"""``hil campaign``: thousands of runs, their statistics, and the replay of one."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from servobench.hil.machine.extras import MissingExtra, is_installed
from servobench.hil.machine.parent_process import messages, results, tell_parent
from servobench.hil.terminal.commands import PlainGroup, add_commands, end_with
from servobench.hil.terminal.options import JsonOption, flag, valued
from servobench.hil.terminal.output import columns, echo, say, say_written
from servobench.hil.verdict.verdict import ExitStatus

if TYPE_CHECKING:
    from servobench.hil.campaign.campaign import Campaign, CampaignProgress


class SweepGroup(PlainGroup):
    """Lets a sweep file take the place of a command: ``hil campaign SWEEP.toml``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the command ``run`` before a sweep file."""
        if args and args[0] not in (*self.commands, *ctx.help_option_names):
            args = ["run", *args]
        return super().parse_args(ctx, args)


campaign = typer.Typer(name="campaign", cls=SweepGroup, help="Run a bench many times.", no_args_is_help=True)


FOUND_SHOWN = 40
"""Lines shown; the column ``findings`` has all."""


DirArgument = Annotated[Path, typer.Argument(metavar="DIR", help="The folder of the campaign.")]


def run(
    sweep: Annotated[Path, typer.Argument(metavar="SWEEP.toml", help="The sweep file.")],
    workers: Annotated[
        int | None, valued("--workers", "N", "Number of processes; default: one per core.", min=1, max=1024)
    ] = None,
    dask: Annotated[
        str | None, valued("--dask", "ADDRESS", "Run on the workers of this Dask scheduler.")
    ] = None,
    resume: Annotated[bool, flag("--resume", "Resume the campaign in the folder.")] = False,
    out: Annotated[
        Path | None, valued("--out", "DIR", "Folder of the campaign; default: campaigns/NAME.")
    ] = None,
    against: Annotated[
        Literal["certificate"] | None,
        valued("--against", None, "Check every run that meets the premises of its certificate against it."),
    ] = None,
    seconds: Annotated[
        float | None, valued("--seconds", "S", "Stop after this time; --resume continues.", min=0.0)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run a sweep file to its end. Results do not depend on the number of workers, nor on their fate.

    Exit status: 0 run to its end, whatever the runs' outcomes; 2 bad input; 130 ended by a signal, --resume
    goes on. With --against certificate: 7 a counter-example ended it; 6 no run was within the premises. 1:
    your own check (the table own of the sweep) reports a run. In full: hil docs campaigns

    Examples:
      hil campaign sweep.toml
    """
    from servobench.hil.campaign.campaign import run_campaign
    from servobench.hil.campaign.plan import CampaignPlan

    plan = CampaignPlan.load(sweep)
    folder = out or Path("campaigns") / plan.sweep.campaign.name
    tell_parent(advice=f"hil campaign {sweep} --out {folder} --resume goes on")
    line = _ProgressLine()
    try:
        done = run_campaign(
            plan,
            folder,
            workers=workers,
            dask=dask,
            resume=resume,
            against_certificate=against is not None,
            seconds=seconds,
            progress=line.show,
            note=lambda text: say(f"hil: note: {text}"),
        )
    finally:
        line.end()
    _print(done, as_json)
    if against is not None:
        done.hold_certificate()
    end_with(ExitStatus.FAILED if done.found else ExitStatus.PASSED)


def report(folder: DirArgument, as_json: JsonOption = False) -> None:
    """Write DIR/report.html: rates with their intervals, heat maps, worst cases, influences; and
    DIR/campaign.rrd, which hil view opens.

    Examples:
      hil campaign report campaigns/first
    """
    from servobench.drivers.written_file import written
    from servobench.hil.campaign.campaign import Campaign
    from servobench.hil.campaign.report import write_report
    from servobench.hil.rows.run_files import CAMPAIGN_PAGE

    done = Campaign.load(folder)
    place = folder / "report.html"
    with written("DIR", place) as part:
        write_report(done, part)
    files = [place]
    if is_installed("rerun"):
        from servobench.hil.campaign.page import write_page

        with written("DIR", folder / CAMPAIGN_PAGE) as part:
            write_page(done, part)
        files.append(folder / CAMPAIGN_PAGE)
    else:
        say(f"hil: note: {MissingExtra('rerun', CAMPAIGN_PAGE)}")
    _print(done, as_json)
    for file in files:
        say_written(file)
    end_with(ExitStatus.PASSED)


def replay(
    folder: DirArgument,
    number: Annotated[int, valued("--run", "K", "Number of the run.", min=0)],
    record: Annotated[
        Path | None, valued("--into", "DIR", "Folder of the recording; default: DIR/replays/run-K.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Repeat one run of a campaign with everything recorded; its digest must be that of the campaign.

    Exit status: that of the run's verdict; 70 if the digest is another.

    Examples:
      hil campaign replay campaigns/first --run 3
    """
    from servobench.hil.campaign.campaign import Campaign

    done = Campaign.load(folder).replay(number, record)
    summary = done.summary
    if as_json:
        echo(json.dumps(summary.as_json(), allow_nan=False))
    else:
        echo(f"run {number}: {summary.verdict.outcome}; digest {summary.digest}, as in the campaign")
        for text in done.findings or ():
            echo(f"found: {text}")
        say_written(Path(summary.recording))
    end_with(summary.verdict.exit_status)


add_commands(campaign, run, report, replay)


class _ProgressLine:
    """Shows progress on stderr: one line on a terminal, else a line every so many runs."""

    def __init__(self) -> None:
        self._percent = -1
        self._last: CampaignProgress | None = None
        self._on_terminal = messages().isatty()

    def show(self, at: "CampaignProgress") -> None:
        self._last = at
        percent = 100 * at.done // at.planned
        if percent == self._percent and not self._on_terminal:
            return
        self._percent = percent
        text = (
            f"{at.done}/{at.planned} runs  {at.passed} passed  {at.runs_per_s:.1f}/s  "
            f"{_duration(at.left_s)} left at most"
        )
        if self._on_terminal:
            print(f"\r{text:<78}", end="", file=messages(), flush=True)
        else:
            say(text)

    def end(self) -> None:
        if self._last is not None and self._on_terminal:
            print(file=messages(), flush=True)
        if self._last is not None:
            say(f"{self._last.runs_per_s:.1f} runs a second")


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _print(done: "Campaign", as_json: bool) -> None:
    from servobench.hil.campaign.figures import failure_line, figures_of

    figures = figures_of(done)
    if as_json:
        echo(json.dumps(figures, allow_nan=False))
        return
    from rich.console import Console

    table = columns("point", "runs", "passed", "pass rate", "interval", right=("runs", "passed", "pass rate"))
    for point in figures["points"]:
        rate, low, high = (point[name] for name in ("rate", "low", "high"))
        shown = "-" if rate is None else f"{100 * rate:.2f} %"
        counts = (str(point[name]) for name in ("runs", "passed"))
        table.add_row(point["point"] or "all", *counts, shown, f"{100 * low:.2f} to {100 * high:.2f} %")
    Console(width=110, soft_wrap=True, file=results()).print(table)
    echo(f"{figures['passed']} of {figures['runs']} runs passed, {figures['planned']} were planned")
    if "failure" in figures:
        echo(failure_line(figures["failure"]))
    if done.plan.own.checks:
        echo(f"the check found something in {len(done.found)} runs")
    for line in done.found_lines()[:FOUND_SHOWN]:
        echo(line)
    for title, each in figures["certificate"].get("runs", {}).items():
        echo(f"certificate {title}: {each} runs")
    echo(f"intervals of {100 * figures['confidence']:g} %, {figures['interval']}; campaign {done.folder}")
