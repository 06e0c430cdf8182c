"""``hil runs``: the recordings, and how they ended."""

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.drivers.errors import printable
from servobench.hil.terminal.options import JsonOption, UnsealedOption, valued
from servobench.hil.terminal.output import put, say, write_line

if TYPE_CHECKING:
    from servobench.hil.reviewing.run_index import ListedRun


def runs(
    folder: Annotated[
        Path, typer.Argument(metavar="[DIR]", help="Folder to search, with its subfolders.")
    ] = Path("runs"),
    bench: Annotated[str, valued("--bench", "NAME", "Part of the bench's name.")] = "",
    drive: Annotated[str, valued("--drive", "TEXT", "Part of a drive's name.")] = "",
    controller: Annotated[str, valued("--controller", "KIND", "Part of a controller's kind.")] = "",
    verdict: Annotated[
        str, valued("--verdict", "TEXT", "Beginning of the verdict, or of the state without one.")
    ] = "",
    commit: Annotated[str, valued("--commit", "HASH", "Beginning of the commit.")] = "",
    since: Annotated[
        datetime | None,
        typer.Option(
            "--since",
            metavar="DATE",
            help="Local time: 2026-03-14 or 2026-03-14T09:30.",
            formats=["%Y-%m-%d", "%Y-%m-%dT%H:%M", "%Y-%m-%dT%H:%M:%S"],
        ),
    ] = None,
    unsealed: UnsealedOption = False,
    as_json: JsonOption = False,
) -> None:
    """List recordings by time: bench, drives, controllers, verdict, commit, and the incomplete ones.

    Each is checked against its seal, which reads all of its files; --unsealed is quicker.

    Exit status: 0, even if there is none; 2 for a DIR that is no folder.

    Examples:
      hil runs
    """
    from servobench.hil.reviewing.run_index import RunFilter, list_runs

    local = None if since is None else since.astimezone()
    chosen = RunFilter(bench, drive, controller, verdict, commit, local)
    listed = list_runs(folder, chosen, unsealed=unsealed)
    put({"runs": [run.as_json() for run in listed]}, as_json, lambda _figures: _print(listed, folder))


def _print(listed: "list[ListedRun]", folder: Path) -> None:
    """Print one line each, of any length: the path comes last, to be copied whole."""
    if not listed:
        say(f"no recording in {folder} that is asked for")
        return
    rows: list[tuple[str, ...]] = [("time", "bench", "verdict", "controller", "drive", "commit", "recording")]
    rows += [_row(run) for run in listed]
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    for row in rows:
        line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        write_line(line.rstrip())
    for run in listed:
        if run.note:
            say(f"hil: note: {printable(run.path)}: {printable(run.note)}")


def _row(run: "ListedRun") -> tuple[str, ...]:
    drives = dict.fromkeys(drive.partition(" (vendor")[0] for drive in run.drives)
    cells = (
        run.at.astimezone().strftime("%Y-%m-%d %H:%M:%S"),
        run.bench,
        run.verdict or run.state.value,
        ", ".join(dict.fromkeys(run.controllers)),
        ", ".join(drives),
        run.commit[:10],
        run.path,
    )
    return tuple(printable(cell) for cell in cells)
