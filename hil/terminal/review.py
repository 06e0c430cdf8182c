"""``hil review``: a recorded run judged again from its files, or a log of another program by a bench."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NoReturn

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import JsonOption, UnsealedOption, valued
from servobench.hil.terminal.output import columns, put, say, say_written

if TYPE_CHECKING:
    from servobench.hil.recorded.judgement import Judged
    from servobench.hil.recorded.log_review import LogReview
    from servobench.hil.recorded.recorded_run import RecordedRun

_STORY_MAX: Final = 20
"""Changes of state and EMCYs of an axis that the terminal shows."""


def review(
    run: Annotated[
        Path | None, typer.Argument(metavar="[RUN]", help="The folder of a run; none beside --log.")
    ] = None,
    log: Annotated[
        Path | None,
        valued("--log", "LOG", "A log of another program, as hil trace reads it; with --bench."),
    ] = None,
    bench: Annotated[
        Path | None, valued("--bench", "BENCH.toml", "With --log: drives, period, units and limits.")
    ] = None,
    against: Annotated[
        Path | None,
        valued(
            "--against",
            "REQUIREMENTS.toml",
            "File with a table \\[verdict]; default: the run's own limits.",
        ),
    ] = None,
    report: Annotated[
        Path | None, valued("--report", "FILE", "Write a report with pictures: one .html or .md file.")
    ] = None,
    signers: Annotated[
        Path | None,
        valued("--signers", "FILE", "Check the signature by these allowed signers of ssh-keygen."),
    ] = None,
    unsealed: UnsealedOption = False,
    as_json: JsonOption = False,
) -> None:
    """Judge a recorded run by its own limits or by others, from the recording alone.

    A controller's certificate counts too: a run with --allow-uncertified outside its certificate does not
    pass here. Exit status: see hil docs exit-status; 2 for an incomplete recording.

    With --log: cycles by SYNC, delays and losses of each PDO, states and EMCYs of the bench's drives, whoever
    ran them; limits on dropouts, delays and missed SYNCs are judged.

    Examples:
      hil review runs/monday
      hil review runs/monday --report monday.html
      hil review --log press.asc --bench bench.toml   # the log of a real bus
    """
    if log is not None:
        if run is not None or bench is None or against is not None or signers is not None:
            raise BadInput(
                "--log", "", str(run or log), "--bench BENCH beside it; no RUN, --against or --signers"
            )
        _review_log(log, bench, report, as_json)
    if run is None or bench is not None:
        raise BadInput("hil review", "", str(bench or ""), "a RUN, or --log LOG --bench BENCH")
    from servobench.hil.recorded.judgement import judge_run

    judged = judge_run(_opened(run, signers, unsealed), against)
    put(judged.summary.as_json() | {"seal": judged.run.seal}, as_json, lambda _figures: _print(judged))
    if report is not None:
        from servobench.hil.recorded.report import write_report

        write_report(judged, report)
        say_written(report)
    raise typer.Exit(judged.summary.verdict.exit_status)


def _opened(run: Path, signers: Path | None, unsealed: bool) -> "RecordedRun":
    from servobench.hil.recorded.recorded_run import open_run

    opened = open_run(run, unsealed=unsealed)
    if signers is None:
        return opened
    from servobench.hil.recorded.signature import signed_by

    if unsealed:
        raise BadInput(
            "--signers", "", str(signers), "no --unsealed beside it: it is the seal that is signed"
        )
    return replace(opened, seal=f"{opened.seal}; signed by {signed_by(opened.folder, signers)}")


def _review_log(log: Path, bench: Path, report: Path | None, as_json: bool) -> NoReturn:
    from servobench.hil.configuration.bench_file import load_bench
    from servobench.hil.recorded.log_review import review_log

    reviewed = review_log(log, load_bench(bench))
    put(reviewed.as_json(), as_json, lambda _figures: _print_log(reviewed))
    if report is not None:
        from servobench.hil.recorded.report import write_log_report

        write_log_report(reviewed, report)
        say_written(report)
    raise typer.Exit(reviewed.exit_status)


def _print_log(reviewed: "LogReview") -> None:
    from rich.console import Console

    from servobench.hil.recorded.report import PDO_HEADS, limit_lines, pdo_rows, story_of, sync_lines

    console = Console(highlight=False)
    content = reviewed.content
    seconds = (content.end_ns - content.begin_ns) / 1e9
    console.print(
        f"{reviewed.path}: {content.frames} frames in {seconds:.3f} s, by {reviewed.config.bench.name}",
        soft_wrap=True, markup=False,
    )  # fmt: skip
    for line in sync_lines(reviewed):
        console.print(line, soft_wrap=True, markup=False)
    table = columns(*PDO_HEADS, right=PDO_HEADS[2:3] + PDO_HEADS[4:], no_wrap=True)
    for row in pdo_rows(reviewed):
        table.add_row(*row)
    console.print(table)
    for axis in reviewed.axes:
        story = story_of(axis)
        for at, what, text in story[:_STORY_MAX]:
            console.print(f"{at:14.6f} {axis.name} {what:<5} {text}", soft_wrap=True, markup=False)
        if len(story) > _STORY_MAX:
            console.print(f"{'':14} {axis.name} {len(story) - _STORY_MAX} more: --json or --report has them")
    if reviewed.checks:
        limits = columns("requirement", "value", "at most", "", right=("value", "at most"))
        for row in limit_lines(reviewed):
            limits.add_row(*row)
        console.print(limits)
    for _, text in reviewed.findings:
        console.print(text, soft_wrap=True, markup=False)
    for note in reviewed.notes:
        say(f"hil: note: {note}")
    if reviewed.unjudged:
        say(f"hil: note: not told by a log: {', '.join(reviewed.unjudged)}")
    console.print(reviewed.verdict.upper(), style="bold")


def _print(judged: "Judged") -> None:
    from rich.console import Console
    from rich.text import Text

    from servobench.hil.verdict.summary_text import limit_rows
    from servobench.hil.verdict.verdict import verdict_title

    console = Console(highlight=False)
    title = f"{judged.run.title()}, by {judged.against}; {judged.run.seal}"
    console.print(title, soft_wrap=True, markup=False)
    table = columns("requirement", "value", "at most", "", "worst", right=("value", "at most"))
    for row in limit_rows(judged.summary.verdict.limits):
        table.add_row(*map(Text, row))
    console.print(table)
    for finding in judged.summary.verdict.findings:
        console.print(f"{finding.outcome}: {finding.text}", soft_wrap=True, markup=False)
    console.print(verdict_title(judged.summary.verdict), style="bold")
