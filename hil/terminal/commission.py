"""``hil commission`` and ``hil restore``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from servobench.hil.machine.parent_process import tell_parent
from servobench.hil.terminal.commands import end_with
from servobench.hil.terminal.options import (
    AllowOption,
    BitrateOption,
    DriveBusOption,
    DriveFaultsOption,
    DriveNodeOption,
    DryRunOption,
    HeartbeatTimeoutOption,
    JsonOption,
    UnwatchedOption,
    YesOption,
    allowed,
    bus_option,
    fault_plan,
    flag,
    seed_option,
    valued,
)
from servobench.hil.terminal.output import put, say
from servobench.hil.verdict.verdict import ExitStatus


@dataclass(frozen=True, slots=True, kw_only=True)
class CommissionOptions:
    """Options of ``hil commission``."""

    bus: Annotated[
        str,
        bus_option(
            "hub:NAME, socketcan:can0, INTERFACE:CHANNEL, or simulated with --rehearse or --rehearse-eds."
        ),
    ]
    node: DriveNodeOption
    out: Annotated[Path, valued("--out", "DIR", "Folder for report, files and journal.")]
    eds: Annotated[Path | None, valued("--eds", "FILE", "EDS, DCF, XDD or XDC of the drive.")] = None
    motor: Annotated[
        Path | None, valued("--motor", "NAMEPLATE.toml", "Nameplate of the motor, and limits.")
    ] = None
    yes: YesOption = False
    dry_run: DryRunOption = False
    store: Annotated[
        bool, flag("--store", "Store the settings in the drive (1010h) instead of undoing them.")
    ] = False
    period_us: Annotated[
        int | None, valued("--period-us", None, "Period of the cycle; default: chosen.", min=250, max=100_000)
    ] = None
    heartbeat_timeout_ms: HeartbeatTimeoutOption = 150
    unwatched: UnwatchedOption = False
    bitrate: BitrateOption = 1_000_000
    rehearse: Annotated[
        int | None, valued("--rehearse", "SEED", "With --bus simulated: the drive of this seed.", min=0)
    ] = None
    rehearse_eds: Annotated[
        Path | None,
        valued(
            "--rehearse-eds",
            "FILE",
            "With --bus simulated: a drive made from this data sheet, the default of --eds.",
        ),
    ] = None
    trust_nameplate: Annotated[
        bool,
        flag(
            "--trust-nameplate", "Trust the nameplate, without asking, where the drive contradicts it by far."
        ),
    ] = False
    allow: AllowOption = None
    operator: Annotated[str | None, valued("--operator", "NAME", "Operator, for the certificate.")] = None
    site: Annotated[str | None, valued("--site", "PLACE", "Place, for the certificate.")] = None
    lab: Annotated[
        Path | None, valued("--lab", "FILE", "TOML with operator, site and order; options go before it.")
    ] = None
    as_json: JsonOption = False


def commission(asked: CommissionOptions) -> None:
    """Commission a drive: identity, units, polarity, limits, friction, inertia, delays, controller, report.

    Each step announces itself, asks, acts and checks. All changes are undone at the end, unless --store; hil
    restore needs DIR/journal.jsonl after a crash. Any key stops a moving shaft.

    Exit status: 0 done, 1 a step failed or the end came early, 2 bad input, 3 bus or drive fault, 4 done, and
    disturbed by others.

    Examples:
      hil commission --bus simulated --node 1 --rehearse 7 --out lab --yes
      hil commission --bus socketcan:can0 --node 1 --out lab   # a real drive
    """
    from servobench.hil.commissioning.request import (
        CommissionRequest,
        Nameplate,
        load_laboratory,
        load_nameplate,
    )

    request = CommissionRequest(
        bus=asked.bus,
        node=asked.node,
        out=asked.out,
        eds=asked.eds,
        nameplate=Nameplate() if asked.motor is None else load_nameplate(asked.motor),
        bitrate_bit_s=asked.bitrate,
        period_us=asked.period_us,
        dry_run=asked.dry_run,
        store=asked.store,
        trust_nameplate=asked.trust_nameplate,
        heartbeat_timeout_ms=asked.heartbeat_timeout_ms,
        unwatched=asked.unwatched,
        allow=allowed(asked.allow),
        laboratory=load_laboratory(asked.lab, asked.operator, asked.site),
    )
    from servobench.hil.commissioning.commission import run_command

    if not asked.dry_run:
        advice = f"{request.restore_command} puts back what was changed in the drive"
        tell_parent(bus=asked.bus, bitrate=asked.bitrate, nodes=[asked.node], advice=advice)

    result, figures = run_command(
        request,
        yes=asked.yes,
        rehearse=asked.rehearse,
        rehearse_eds=asked.rehearse_eds,
        plate_given=asked.motor is not None,
    )
    put(figures, asked.as_json, lambda _figures: None)
    end_with(result)


def restore(
    journal: Annotated[
        Path, typer.Argument(metavar="JOURNAL", help="journal.jsonl of a commissioning or a measurement.")
    ],
    bus: Annotated[str | None, bus_option("The bus, if its name has changed since.")] = None,
    store: Annotated[bool, flag("--store", "Have the drive keep what it holds then (1010h).")] = False,
    as_json: JsonOption = False,
) -> None:
    """Undo every change of a commissioning or a measurement, after a crash or a lost bus.

    What the drive has stored (--store of another command) comes back when it is switched on, but for --store.

    Examples:
      hil restore lab/journal.jsonl   # a real drive
    """
    from servobench.hil.commissioning.restore_command import run_restore

    outcome: dict[str, Any] = run_restore(journal, bus, store)
    put(outcome, as_json, lambda _figures: say("\n".join(outcome["text"])))
    raise typer.Exit(ExitStatus.PASSED if outcome["complete"] else ExitStatus.FAILED)


def rehearse(
    bus: DriveBusOption,
    node: DriveNodeOption,
    seed: Annotated[int, seed_option("Seed of the drive: determines everything hidden.", most=None)],
    nameplate: Annotated[
        Path | None, valued("--nameplate", "FILE", "Write the motor's nameplate, for hil commission.")
    ] = None,
    truth: Annotated[Path | None, valued("--truth", "FILE", "Write the true values, for comparison.")] = None,
    faults: DriveFaultsOption = None,
    drift_ppm: Annotated[
        float, valued("--drift-ppm", None, "Drift of the drive's clock.", min=-1000, max=1000)
    ] = 0.0,
    bitrate: BitrateOption = 1_000_000,
) -> None:
    """Simulate an unknown drive, with faults in its settings, until Ctrl-C.

    Examples:
      hil rehearse --bus hub:other --node 1 --seed 7 --nameplate plate.toml &
    """
    from servobench.hil.commissioning.rehearsal import rehearse as serve_unknown

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
