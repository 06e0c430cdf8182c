"""``hil fit``: a twin, the simulated drive fitted to recordings of a real one."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.drivers.errors import MISSING, BadInput
from servobench.hil.terminal.options import JsonOption, UnsealedOption, motor_file, valued
from servobench.hil.terminal.output import echo, put, say, say_written, titled
from servobench.hil.verdict.verdict import ExitStatus

if TYPE_CHECKING:
    from servobench.hil.twin.fitting import Fit


def fit(
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="The motor file to write, or with --plan the bench.")
    ],
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="[RECORDING...]", help="Folders of runs.")
    ] = None,
    plan: Annotated[
        Path | None,
        valued("--plan", "BENCH.toml", "Write the bench that records what a fit wants of this one's drive."),
    ] = None,
    start: Annotated[
        Path | None,
        valued("--start", "MOTOR.toml", "What is not determined stays its; default: the run's motor."),
    ] = None,
    hold_out: Annotated[
        Path | None, valued("--hold-out", "RECORDING", "A run to predict, which is not fitted.")
    ] = None,
    fixed: Annotated[
        list[str] | None, valued("--fix", "KEY", "A key that keeps the start's value; repeatable.")
    ] = None,
    axis: Annotated[str | None, valued("--axis", "NAME", "Axis; needed if the bench has several.")] = None,
    bootstrap: Annotated[
        int,
        valued("--bootstrap", "N", "Record and fit the twin itself so often, for bias and widths.", min=0),
    ] = 0,
    unsealed: UnsealedOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fit the simulated drive to recordings, and write it as a motor file with its uncertainty.

    Inertia, frictions, offset, dead time and speed filter; what the recordings do not determine keeps the
    start's value and says so. Torques are in the drive's own unit. --plan fits nothing: it writes a bench
    file whose motion determines all of them, within the limits of the bench named, without load and faults.

    Exit status: 0 fitted; 1 the recording held out is predicted worse than 1.2 times what is left of those
    fitted, or the fit did not come to an end; 2 bad input.

    Examples:
      hil fit --plan bench.toml --out excite.toml
      hil run excite.toml --record runs/excited
      hil fit runs/excited --out twin.toml
      hil fit runs/excited --start motor.toml --bootstrap 20 --out twin.toml
    """
    from servobench.drivers.written_file import write_file
    from servobench.hil.twin.fitting import fit_recordings
    from servobench.hil.twin.twin_file import fit_json, motor_text

    fitted = _fitted(recordings or [], plan, hold_out)
    if plan is not None:
        _write_plan(plan, axis, out)
        return
    found = fit_recordings(
        fitted,
        start=None if start is None else motor_file(start, "--start"),
        hold_out=hold_out,
        fixed=fixed or (),
        axis=axis,
        bootstrap=bootstrap,
        unsealed=unsealed,
    )
    write_file("--out", out, motor_text(found))
    put(fit_json(found) | {"structure": "rigid"}, as_json, lambda _figures: _print(found))
    say_written(out)
    raise typer.Exit(_status(found))


def _fitted(recordings: list[Path], plan: Path | None, hold_out: Path | None) -> list[Path]:
    """Return the recordings to fit, none beside a plan. Raises BadInput."""
    if (plan is None) == (not recordings):
        told = MISSING if plan is None else str(plan)
        raise BadInput("RECORDING", "", told, "folders of runs, or --plan with a bench file, not both")
    if hold_out is not None and hold_out in recordings:
        raise BadInput("--hold-out", "", str(hold_out), "a recording that is not fitted")
    return recordings


def _write_plan(bench: Path, axis: str | None, out: Path) -> None:
    from servobench.drivers.written_file import write_file
    from servobench.hil.terminal.current_loop_options import bench_axis
    from servobench.hil.twin.plan import excitation_text

    if out.resolve() == bench.resolve() or out.resolve().parent != bench.resolve().parent:
        expected = f"another file in {bench.resolve().parent}: the paths in {bench.name} count from there"
        raise BadInput("--out", "", str(out), expected)
    write_file("--out", out, excitation_text(bench, *bench_axis(bench, axis)))
    say_written(out)


def _status(found: "Fit") -> ExitStatus:
    from servobench.hil.twin.replay import PREDICTED_MAX

    ratio = found.held_out_ratio
    if not found.converged:
        say("hil: the fit did not come to an end: the start is too far off, or the shaft is not rigid")
        return ExitStatus.FAILED
    if ratio is not None and ratio > PREDICTED_MAX:
        say(
            f"hil: the recording held out is predicted {ratio:.2f} times worse than those fitted (limit "
            f"{PREDICTED_MAX:g}): the drive has what the twin lacks, which no uncertainty here covers"
        )
        return ExitStatus.FAILED
    return ExitStatus.PASSED


def _print(found: "Fit") -> None:
    from rich.console import Console

    from servobench.drivers.rotation import RPM_PER_RAD_S
    from servobench.hil.twin.twin_file import NOT_FITTED, key_text, left_out_of_start

    speed, position, torque = found.spread
    lines = {key.name: key_text(key) for key in found.keys}
    lines["windows"] = f"{len(found.windows)} fitted, {found.left_out} left out"
    left = f"{speed * RPM_PER_RAD_S:.3g} r/min, {position:.3g} rad, {torque:.3g} N m (rms)"
    lines["what is left"] = left
    if found.held_out_ratio is not None:
        lines["held out"] = f"{found.held_out_ratio:.3g} of that"
    Console(soft_wrap=True).print(titled(lines))
    echo(f"Not fitted: {NOT_FITTED}.")
    if left_out := left_out_of_start(found):
        echo(f"Left out of the start, as the twin is rigid: {', '.join(left_out)}.")
