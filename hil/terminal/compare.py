"""``hil compare``: recorded runs side by side, and a run against a baseline."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import JsonOption, UnsealedOption, motor_file, valued
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
    twin: Annotated[
        Path | None, valued("--twin", "MOTOR.toml", "Replay one run on this twin, and compare both.")
    ] = None,
    axis: Annotated[str | None, valued("--axis", "NAME", "Axis for --twin; default: the only one.")] = None,
    unsealed: UnsealedOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare recorded runs, cycle by cycle: figures, differences of the signals, first divergence.

    With --twin one run is replayed on a twin, with its commands when they acted: where the drive is another
    than the uncertainty of the twin allows, over time, angle and frequency.

    Exit status: 0 compared, or within the tolerances or what the twin allows; 1 a tolerance is exceeded, or
    the drive is outside; 2 bad input; 6 a figure with a tolerance is not measured in both runs, or no window
    is in the twin's range of validity.

    Examples:
      hil compare runs/monday runs/tuesday
      hil compare runs/real --twin twin.toml   # of a real drive
    """
    if rrd is not None and (rrd.suffix != ".rrd" or not rrd.parent.is_dir()):
        raise BadInput("--rrd", "", str(rrd), "a .rrd file in an existing folder")
    if twin is not None:
        if len(runs) > 1 or baseline is not None or tolerances is not None:
            raise BadInput("--twin", "", str(twin), "one RUN, without --baseline and --tolerances")
        _on_twin(runs[0], twin, axis, rrd, unsealed, as_json)
    folders = ([baseline] if baseline is not None else []) + runs
    if len(folders) < 2:
        raise BadInput("RUN", "", str(runs[0]), "a second run, or --baseline, to compare it with")
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


def _on_twin(
    run: Path, twin: Path, axis: str | None, rrd: Path | None, unsealed: bool, as_json: bool
) -> None:
    from servobench.hil.twin.replay import replay, replay_json, replay_lines

    replayed = replay(run, motor_file(twin, "--twin"), axis=axis, unsealed=unsealed)
    lines = replay_lines(replayed)
    put(replay_json(replayed), as_json, lambda _figures: typer.echo("\n".join(lines)))
    if rrd is not None:
        from servobench.drivers.written_file import written
        from servobench.hil.twin.replay_page import write_replay

        with written("--rrd", rrd) as place:
            write_replay(replayed, "```\n" + "\n".join(lines) + "\n```\n", place)
        say_written(rrd)
    results = {
        "within": ExitStatus.PASSED,
        "outside": ExitStatus.FAILED,
        "out of range": ExitStatus.INCOMPLETE,
    }
    raise typer.Exit(results[replayed.judgement])


def _status(compared: "list[Against]") -> ExitStatus:
    results = [one.kept for each in compared for one in each.regressions]
    if False in results:
        return ExitStatus.FAILED
    return ExitStatus.INCOMPLETE if None in results else ExitStatus.PASSED
