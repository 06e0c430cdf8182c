"""``hil review``: a recorded run judged again from its files."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import JsonOption, RunArgument, UnsealedOption, valued
from servobench.hil.terminal.output import columns, put, say_written

if TYPE_CHECKING:
    from servobench.hil.recorded.judgement import Judged


def review(
    run: RunArgument,
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

    Examples:
      hil review runs/monday
      hil review runs/monday --report monday.html
    """
    from servobench.hil.recorded.judgement import judge_run
    from servobench.hil.recorded.recorded_run import open_run

    opened = open_run(run, unsealed=unsealed)
    if signers is not None:
        from servobench.hil.recorded.signature import signed_by

        if unsealed:
            raise BadInput(
                "--signers", "", str(signers), "no --unsealed beside it: it is the seal that is signed"
            )
        opened = replace(opened, seal=f"{opened.seal}; signed by {signed_by(opened.folder, signers)}")
    judged = judge_run(opened, against)
    put(judged.summary.as_json() | {"seal": judged.run.seal}, as_json, lambda _figures: _print(judged))
    if report is not None:
        from servobench.hil.recorded.report import write_report

        write_report(judged, report)
        say_written(report)
    raise typer.Exit(judged.summary.verdict.exit_status)


def _print(judged: "Judged") -> None:
    from rich.console import Console
    from rich.text import Text

    from servobench.hil.verdict.summary_text import limit_rows
    from servobench.hil.verdict.verdict import verdict_title

    console = Console(highlight=False)
    title = f"{judged.run.title()}, by {judged.against}; {judged.run.seal}"
    console.print(title, soft_wrap=True, markup=False)
    table = columns("requirement", "value", "at most", "", "worst", right=("value", "at most"))
    for row in limit_rows(judged.summary.verdict):
        table.add_row(*map(Text, row))
    console.print(table)
    for finding in judged.summary.verdict.findings:
        console.print(f"{finding.outcome}: {finding.text}", soft_wrap=True, markup=False)
    console.print(verdict_title(judged.summary.verdict), style="bold")
