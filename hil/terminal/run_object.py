"""The one object that ``hil run --json`` prints, however it ends."""

import json
import sys
from pathlib import Path
from typing import Any

import typer

from servobench.hil.machine.parent_process import results, tell_parent
from servobench.hil.terminal.commands import PlainCommand
from servobench.hil.verdict.summary import Summary, summary_without_run
from servobench.hil.verdict.verdict import ExitStatus, Finding, VerdictKind, outcome_of_status

_USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]
"""UsageError of whichever click typer brings along."""


class RunObject:
    """The object of one call of the command."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._summary: Summary | None = None
        self._printed: int | None = None
        """The exit status in the printed object."""

    def concluded(self, summary: Summary) -> None:
        """Take in the summary: the run has ended."""
        self._summary = summary

    def failed(self, status: int, text: str) -> int:
        """Print the result of the run, if there was one, after an error of the command.

        Returns the status to leave with: that of the gravest fault; an object already printed stands.
        """
        if self._as_json and self._printed is not None:
            return self._printed
        outcome = outcome_of_status(status)
        summary = self._summary
        if summary is None:
            summary = summary_without_run(outcome, text)
        elif not summary.verdict.of(outcome):
            summary = summary.also(Finding(outcome, text))
        self.print(summary)
        return summary.verdict.exit_status

    def print(self, summary: Summary) -> None:
        """Print the summary as JSON, if requested."""
        if self._as_json:
            typer.echo(json.dumps(summary.as_json(), allow_nan=False), file=results())
        self._printed = status = summary.verdict.exit_status
        digest = summary.digest
        tell_parent(concluded={"status": status, "digest": digest, "recording": summary.recording})


def read_back(summary: Summary) -> Summary:
    """Return the summary; a run that would leave with 0 becomes not recorded if its recording does not match
    its seal.

    The one place where the seal stands between a run and its exit status.
    """
    if summary.verdict.exit_status != ExitStatus.PASSED or not summary.recording:
        return summary
    from servobench.drivers.errors import BadInput
    from servobench.hil.rows.seal import SEALED, check_seal

    try:
        seal = check_seal(Path(summary.recording))
    except BadInput as error:
        seal = str(error)
    return summary if seal == SEALED else summary.also(Finding(VerdictKind.NOT_RECORDED, seal))


def not_begun(status: int, text: str) -> None:
    """Print the object, if requested, for a program that cannot even read its command line."""
    RunObject(sys.argv[1:2] == ["run"] and "--json" in sys.argv).failed(status, text)


class RunCommand(PlainCommand):
    """Prints the object for an invalid command line too."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Parse the command line, as click does."""
        as_json = "--json" in args
        try:
            return super().make_context(info_name, args, parent, **extra)
        except _USAGE_ERROR as error:
            RunObject(as_json).failed(ExitStatus.BAD_INPUT, str(error))
            raise
