"""``hil compare``: recorded runs side by side, and a run against a baseline."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import JsonOption, UnsealedOption, valued
from servobench.hil.terminal.output import put, say_written
from servobench.hil.verdict.verdict import ExitStatus

if TYPE_CHECKING:
    from servobench.hil.recorded.comparison import Against


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs.")],
    baseline: Annotated[
        Path | None, valued("--baseline", "RUN", "Run to compare the others with; default: the first.")
    ] = None,
    tolerances: Annotated[Path | None, valued("--tolerances", "FILE.toml", "Tolerances, by figure.")] = None,
    rrd: Annotated[
        Path | None, valued("--rrd", "FILE.rrd", "Write the runs side by side and superimposed, for Rerun.")
    ] = None,
    unsealed: UnsealedOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare recorded runs, cycle by cycle: figures, differences of the signals, first divergence.

    Exit status: 0 compared, or within the tolerances; 1 a tolerance is exceeded; 2 bad input; 6 a figure with
    a tolerance is not measured in both runs.

    Examples:
      hil compare runs/monday runs/tuesday
    """
    folders = ([baseline] if baseline is not None else []) + runs
    if len(folders) < 2:
        raise BadInput("RUN", "", str(runs[0]), "a second run, or --baseline, to compare it with")
    if rrd is not None and (rrd.suffix != ".rrd" or not rrd.parent.is_dir()):
        raise BadInput("--rrd", "", str(rrd), "a .rrd file in an existing folder")
    from servobench.hil.recorded.comparison import (
        compare_runs,
        comparison_json,
        comparison_lines,
        load_tolerances,
    )
    from servobench.hil.recorded.recorded_run import open_run

    asked = None if tolerances is None else load_tolerances(tolerances)
    # of half a recording each cycle would be the same
    compared = compare_runs([open_run(folder, unsealed=unsealed, whole=True) for folder in folders], asked)
    lines = comparison_lines(compared)
    put(comparison_json(compared), as_json, lambda _figures: typer.echo("\n".join(lines)))
    if rrd is not None:
        from servobench.drivers.written_file import written
        from servobench.hil.recorded.comparison_page import write_comparison

        with written("--rrd", rrd) as place:
            write_comparison(compared, "```\n" + "\n".join(lines) + "\n```\n", place)
        say_written(rrd)
    raise typer.Exit(_status(compared))


def _status(compared: "list[Against]") -> ExitStatus:
    results = [one.kept for each in compared for one in each.regressions]
    if False in results:
        return ExitStatus.FAILED
    return ExitStatus.INCOMPLETE if None in results else ExitStatus.PASSED
