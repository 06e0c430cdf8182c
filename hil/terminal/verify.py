"""``hil verify``: the proofs in controllers' files, checked with every rounding enclosed."""

from pathlib import Path
from typing import Annotated, Any

import typer

from servobench.hil.terminal.options import JsonOption
from servobench.hil.terminal.output import echo, put
from servobench.hil.verdict.verdict import ExitStatus


def verify(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Controllers that hil design speed wrote.")
    ],
    as_json: JsonOption = False,
) -> None:
    """Prove the certificates of controllers' files anew, from their digits, with every rounding enclosed.

    Exit status: 0 proved, 1 a figure is not proved or a file was changed, 2 a file has no such certificate.

    Examples:
      hil verify examples/controllers/ling2012-static.toml   # hil init --examples
    """
    from servobench.hil.studies.speed.verification import verified

    figures = {"files": [verified(file) for file in files]}
    put(figures, as_json, _show)
    whole = all(each["proved"] for each in figures["files"])
    raise typer.Exit(ExitStatus.PASSED if whole else ExitStatus.FAILED)


def _show(figures: dict[str, Any]) -> None:
    for each in figures["files"]:
        echo(each["file"])
        for claim in each["claims"]:
            result = f"not proved: {claim['refused']}" if claim["refused"] else "proved"
            echo(f"  {claim['key']} = {claim['value']:.9g} {claim['unit']}: {result}")
        for refused in each["premises_refused"]:
            echo(f"  {refused}")
        for key in each["not_checked"]:
            echo(f"  {key}: not checked, its proof is not in the file")
        if each["unchanged"] is False:
            echo("  changed since hil design wrote it")
        elif each["unchanged"] is None:
            echo("  without a digest: whether it was changed cannot be told")
