"""Terminal output of ``hil measure``."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from servobench.design.confidence import CONFIDENCE, share_within_largest
from servobench.hil.machine.parent_process import results
from servobench.hil.measuring.figures import Measured, MeasuredDrive
from servobench.hil.measuring.loss_model import Losses, LossModel
from servobench.hil.measuring.stages import WAYS, Stage
from servobench.hil.measuring.stamp_probe import StampFigures
from servobench.hil.reviewing.network_meter import delays_of
from servobench.hil.terminal.output import columns

RUNS_SHOWN = 8


def print_measured(measured: Measured) -> None:
    """Print stages, losses and clocks of every drive, with their confidence."""
    console = Console(highlight=False, file=results())
    request = measured.request
    state = "enabled" if request.enable else "disabled"
    console.print(
        Text(
            f"{measured.cycles} cycles of {request.period_us} us on {request.bus}, drives {state}; "
            f"{measured.missed} went without SYNC"
        )
    )
    for drive in measured.drives:
        console.print(Text(f"\nNode {drive.node}: {drive.identity}", style="bold"))
        console.print(_stages([*measured.host, *drive.stages]))
        console.print(_losses(drive))
        console.print(Text(_clock(drive)))
        if drive.stamp is not None:
            console.print(Text(stamp_text(drive.stamp)))
        for note in drive.notes:
            console.print(Text(f"  {note}", style="dim"))
    percent = 100.0 * CONFIDENCE
    console.print(
        Text(f"\nIntervals at {percent:g} %. Within the largest: of all delays, those to come included.")
    )
    if measured.surplus:
        late = (
            f"{measured.surplus} SYNCs came to the bus after they were given up, and count as lost before it"
        )
        console.print(Text(late, style="bold yellow"))
    for reason in measured.distrust:
        console.print(Text(f"Not trustworthy: {reason}", style="bold red"))
    for disturbance in measured.disturbances:
        console.print(Text(f"Disturbed: {disturbance}", style="bold red"))


def _stages(stages: list[Stage]) -> Table:
    quantiles = ("p50", "p99", "p99.9", "max", "within")
    table = columns("us", *quantiles, right=quantiles, no_wrap=True)
    table.add_column("")
    for each in stages:
        delays = delays_of(each.times)
        if delays is None:
            table.add_row(Text(each.title), "", "", "", "", "", Text(f"not measured: {each.basis}"))
            continue
        within = f"{100.0 * share_within_largest(each.times.total):.3f} %"
        figures = [f"{value:.1f}" for value in (delays.p50, delays.p99, delays.p999, delays.max)]
        table.add_row(Text(each.title), *figures, within, Text(each.basis))
    return table


def _losses(drive: MeasuredDrive) -> Table:
    table = columns("losses", "lost", "of", "%", "true %", "runs of 1, 2, ...", "model (maximum likelihood)")
    for way, title in WAYS.items():
        losses = drive.losses[way]
        if losses.interval is None:
            table.add_row(title, "", "", "", "", "", Text("not measured"))
            continue
        low, high = (f"{100.0 * end:.3g}" for end in losses.interval)
        table.add_row(
            title,
            str(losses.lost),
            str(losses.known),
            f"{100.0 * losses.lost / losses.known:.3g}",
            f"{low} to {high}",
            _runs(losses),
            Text(losses.why_none if losses.model is None else _model(losses.model)),
        )
    return table


def _runs(losses: Losses) -> str:
    shown = " ".join(str(count) for count in losses.runs[:RUNS_SHOWN])
    return f"{shown} ... to {len(losses.runs)}" if len(losses.runs) > RUNS_SHOWN else shown


def _model(model: LossModel) -> str:
    if model.independent:
        return "independent"
    parameters = model.parameters._asdict()
    return ", ".join(
        f"{name} {parameters[name]:.3g} ({interval.low:.3g} to {interval.high:.3g})"
        for name, interval in model.intervals.items()
    )


def stamp_text(stamp: StampFigures) -> str:
    """Describe the findings about a drive's stamp, and the bench key to set."""
    name = f"stamp {stamp.object}"
    if not stamp.runs:
        return f"{name}: stands still in {stamp.reads} reads, a master sets it or nothing does; not used"
    when = "at the arrival of the SYNC" if stamp.at_sync else "when it is asked for"
    if stamp.unit_us is None or stamp.resolution_us is None:
        return f"{name}: runs, latched {when}, and counts in no unit that is known; not used"
    width = f"wraps at {stamp.bits} bits" if stamp.bits else "did not wrap meanwhile"
    return (
        f"{name}: counts {stamp.unit_us:g} us in steps of {stamp.resolution_us:g} us (for a bench:"
        f" drive.NAME.stamp_resolution_us), {width}; latched {when}, how late cannot be told from a constant"
        " delay"
    )


def _clock(drive: MeasuredDrive) -> str:
    clock = drive.clock
    if clock is None:
        return "clock: the drive puts no stamp beside its speed"
    text = (
        f"clock: drift {clock.drift_ppm:+.2f} ppm (+-{clock.drift_error_ppm:.2f}), "
        f"offset {clock.offset_us:.1f} us (+-{clock.error_us:.1f})"
    )
    if clock.steps:
        text += f", set {clock.steps} times"
    return f"{text}, {drive.uncertain} readings uncertain" if drive.uncertain else text
