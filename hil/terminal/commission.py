"""``hil commission`` and ``hil restore``."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hil.terminal.options import (
    BitrateOption,
    DriveBusOption,
    DriveFaultsOption,
    DriveNodeOption,
    JsonOption,
    bus_option,
    fault_plan,
    flag,
    seed_option,
    valued,
)
from hil.terminal.output import put, say
from hil.verdict.verdict import ExitStatus

UnwatchedOption = Annotated[
    bool,
    flag(
        "--unwatched",
        "Bear a drive that cannot watch its host: slow, weak and short motions; somebody stands by.",
    ),
]
TrustOption = Annotated[
    bool,
    flag(
        "--trust-nameplate",
        "Take the nameplate, unasked, where the drive contradicts it by far.",
    ),
]
RehearsedSheetOption = Annotated[
    Path | None,
    valued(
        "--rehearse-eds",
        "FILE",
        "On --bus simulated: a drive made from that data sheet; --eds is the same one if absent.",
    ),
]


CommissionBusOption = Annotated[
    str,
    bus_option(
        "hub:NAME, socketcan:can0, INTERFACE:CHANNEL, or simulated with --rehearse or --rehearse-eds."
    ),
]


def commission(
    bus: CommissionBusOption,
    node: DriveNodeOption,
    out: Annotated[Path, valued("--out", "DIR", "Folder for report, files and journal.")],
    eds: Annotated[Path | None, valued("--eds", "FILE", "EDS, DCF, XDD or XDC of the drive.")] = None,
    motor: Annotated[
        Path | None, valued("--motor", "NAMEPLATE.toml", "What is printed on the motor, and limits.")
    ] = None,
    yes: Annotated[bool, flag("--yes", "Ask nothing; every step is done.")] = False,
    dry_run: Annotated[bool, flag("--dry-run", "Only read; say what the other steps would do.")] = False,
    store: Annotated[
        bool,
        flag("--store", "Keep the settings in the drive (1010h) instead of putting them back."),
    ] = False,
    period_us: Annotated[
        int | None, typer.Option("--period-us", min=250, max=100_000, help="Cycle; chosen if absent.")
    ] = None,
    heartbeat_timeout_ms: Annotated[
        int,
        typer.Option("--heartbeat-timeout-ms", min=20, max=60_000, help="Silence that host and drive bear."),
    ] = 150,
    unwatched: UnwatchedOption = False,
    bitrate: BitrateOption = 1_000_000,
    rehearse: Annotated[
        int | None,
        typer.Option("--rehearse", metavar="SEED", min=0, help="On --bus simulated: the drive of that seed."),
    ] = None,
    rehearse_eds: RehearsedSheetOption = None,
    trust_nameplate: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Commission a drive: identity, units, polarity, limits, friction, inertia, delays, controller, report.

    Each step says what it will do, asks, does it and checks it. All changes are put back at the end, unless
    --store; DIR/journal.jsonl is what hil restore needs after a crash. Any key stops a moving shaft.

    Exit status: 0 done, 1 a step failed or the end came early, 2 bad input, 3 bus or drive fault.
    """
    from hil.commissioning.request import CommissionRequest, Nameplate, load_nameplate

    plate = load_nameplate(motor) if motor is not None else Nameplate()
    request = CommissionRequest(
        bus=bus,
        node=node,
        out=out,
        eds=eds,
        nameplate=plate,
        bitrate_bit_s=bitrate,
        period_us=period_us,
        dry_run=dry_run,
        store=store,
        trust_nameplate=trust_nameplate,
        heartbeat_timeout_ms=heartbeat_timeout_ms,
        unwatched=unwatched,
    )
    from hil.commissioning.commission import run_command

    result, figures = run_command(
        request, yes=yes, rehearse=rehearse, rehearse_eds=rehearse_eds, plate_given=motor is not None
    )
    put(figures, as_json, lambda _figures: None)
    raise typer.Exit(result)


def restore(
    journal: Annotated[
        Path, typer.Argument(metavar="JOURNAL", help="journal.jsonl of a commissioning, or a measurement's.")
    ],
    bus: DriveBusOption,
    node: DriveNodeOption,
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Put back every object that a commissioning or a measurement changed, after a crash or a lost bus."""
    from hil.commissioning.commission import run_restore

    outcome: dict[str, Any] = run_restore(bus, node, journal, bitrate)
    put(outcome, as_json, lambda _figures: say("\n".join(outcome["text"])))
    raise typer.Exit(ExitStatus.PASSED if outcome["complete"] else ExitStatus.FAILED)


def rehearse(
    bus: DriveBusOption,
    node: DriveNodeOption,
    seed: Annotated[int, seed_option("Which drive: all that is hidden is drawn from it.", most=None)],
    nameplate: Annotated[
        Path | None, valued("--nameplate", "FILE", "Write what is printed on the motor, for hil commission.")
    ] = None,
    truth: Annotated[Path | None, valued("--truth", "FILE", "Write what was drawn, to compare with.")] = None,
    faults: DriveFaultsOption = None,
    drift_ppm: Annotated[
        float,
        typer.Option("--drift-ppm", min=-1000, max=1000, help="How much too fast the drive's clock runs."),
    ] = 0.0,
    bitrate: BitrateOption = 1_000_000,
) -> None:
    """A simulated drive that nobody has described, with faults in what it tells, until Ctrl-C."""
    from hil.commissioning.rehearsal import rehearse as serve_unknown

    serve_unknown(
        bus_spec=bus,
        node=node,
        seed=seed,
        nameplate=nameplate,
        truth_file=truth,
        faults=fault_plan(faults),
        clock_drift_ppm=drift_ppm,
        bitrate_bit_s=bitrate,
        announce=say,
    )
