"""Runs a commissioning, step by step, from the command line to the files, and back to the
drive's former settings."""

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from servobench.drivers.canopen.write_list import WriteList
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.supervision import Release
from servobench.drivers.errors import BadInput, BenchError, PeerFault
from servobench.drivers.sheets.dictionary import LoadedDictionary, load_dictionary
from servobench.drivers.timebase import Duration
from servobench.drivers.wire.adapters import BusSpec, parse_bus_spec
from servobench.drivers.written_file import DiskFull, writing
from servobench.hil.commissioning.certificate import write_certificate
from servobench.hil.commissioning.dialog import Dialog, EmergencyStop, Terminal, say
from servobench.hil.commissioning.drive_left import DriveLeft
from servobench.hil.commissioning.files import set_objects, write_files
from servobench.hil.commissioning.recording import SessionLog
from servobench.hil.commissioning.rehearsal import rehearsed_drive, ways_to_run
from servobench.hil.commissioning.report import Commissioned, as_json, summary_of, write_report
from servobench.hil.commissioning.request import CommissionRequest, Nameplate, Rehearsal
from servobench.hil.commissioning.sequence import Step, run_sequence
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_current import TorqueConstant
from servobench.hil.commissioning.steps_design import Suggest, Verify
from servobench.hil.commissioning.steps_dynamics import Delays, Response
from servobench.hil.commissioning.steps_mechanics import MechanicsStep
from servobench.hil.commissioning.steps_setup import EnableAtZero, SetUp, Watchdog
from servobench.hil.commissioning.steps_static import BusCheck, DumpStep, IdentityCheck, UnitsTold
from servobench.hil.commissioning.steps_stopping import StopProof, StopSettings
from servobench.hil.commissioning.steps_units import MotionUnits, Polarity, Turn
from servobench.hil.commissioning.steps_voltage import VoltageConstant
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.machine.realtime import timing_conditions
from servobench.hil.machine.stopping import stop_signals
from servobench.hil.restoring.journal import JournaledNetwork
from servobench.hil.restoring.restore import DISABLED, restore, store_settings
from servobench.hil.rows.run_files import BENCH_FILE, COMMISSIONING_RECORDING
from servobench.hil.write_lists import COMMISSION
from servobench.virtual_bus.device.canopen_device import CanopenDevice


def all_steps() -> list[Step]:
    """Return new steps, for one commissioning."""
    return [
        BusCheck(),
        IdentityCheck(),
        DumpStep(),
        UnitsTold(),
        SetUp(),
        StopSettings(),
        Watchdog(),
        EnableAtZero(),
        Polarity(),
        MotionUnits(),
        Turn(),
        StopProof(),
        MechanicsStep(),
        TorqueConstant(),
        VoltageConstant(),
        Response(),
        Delays(),
        Suggest(),
        Verify(),
    ]


def run_command(
    request: CommissionRequest,
    *,
    yes: bool,
    rehearse: int | None,
    rehearse_eds: Path | None,
    plate_given: bool,
) -> tuple[int, dict[str, Any]]:
    """Run ``hil commission``; return its exit status and its figures."""
    if rehearse is not None and rehearse_eds is not None:
        raise BadInput("--rehearse-eds", "", str(rehearse_eds), "either it or --rehearse SEED")
    rehearsed = rehearse is not None or rehearse_eds is not None
    spec = parse_bus_spec(request.bus, "--bus")
    devices: Sequence[CanopenDevice] = ()
    if spec.simulated != rehearsed:
        expected = "--rehearse SEED or --rehearse-eds FILE with --bus simulated, and only with it"
        raise BadInput("--bus", "", request.bus, expected)
    if rehearsed:
        rehearsal = Rehearsal(rehearse, rehearse_eds)
        servo, plate = rehearsed_drive(rehearsal, request.node, request.bitrate_bit_s, say)
        devices = [servo]
        request = replace(request, eds=request.eds or rehearse_eds, rehearsal=rehearsal)
        if not plate_given:
            request = replace(request, nameplate=Nameplate.model_validate(plate), trust_nameplate=True)
            say("no --motor: the rehearsed drive's own nameplate is taken, and trusted against the drive")
    return run_steps(request, commission, spec, devices, yes=yes)


def run_steps(
    request: CommissionRequest,
    work: Callable[..., Commissioned],
    spec: BusSpec,
    devices: Sequence[CanopenDevice] = (),
    *,
    yes: bool,
) -> tuple[int, dict[str, Any]]:
    """Open the bus, do ``work``, which is :func:`commission` with steps of its own or without, and say how it
    ended; return the exit status and the figures. ``yes``: ask nobody."""
    if not yes and not request.dry_run and not sys.stdin.isatty():
        raise BadInput("--yes", "", "no terminal to ask at", "--yes, or a terminal as standard input")
    sheet = None
    if request.eds is not None:
        sheet = load_dictionary(request.eds, request.node)
        if sheet.repairs:
            say(f"{request.eds}: {len(sheet.repairs)} repairs, see hil eds")
    dialog = Dialog(say) if yes or request.dry_run else Terminal(sys.stdin, say)
    seed = request.rehearsal.seed or 0 if request.rehearsal else 0
    plan = WorldPlan(spec, request.bitrate_bit_s, seed=seed)
    with stop_signals() as signals, open_world(plan, devices) as world:
        stop = EmergencyStop(signals, sys.stdin)
        with timing_conditions(world.real_time):
            result = work(request, world, dialog, stop, sheet)
    for line in summary_of(request, result):
        say(line)
    if (request.out / BENCH_FILE).exists():
        for line in ways_to_run(request, request.out):
            say(line)
    figures = as_json(request, result)
    if result.error is not None:
        say(f"hil: error: {result.error}")
    return result.exit_status, figures


def commission(
    request: CommissionRequest,
    world: World,
    dialog: Dialog,
    stop: EmergencyStop,
    sheet: LoadedDictionary | None = None,
    steps: Callable[[], Sequence[Step]] | None = None,
    writes: WriteList = COMMISSION,
) -> Commissioned:
    """Run the sequence. In every case the drive is brought to rest and restored, as far as it can be reached,
    and the report says how it was left.

    Raises BadInput if the recording cannot be written; a fault of bus or drive is part of the result.
    """
    title = f"{request.purpose} of node {request.node} on {request.bus}"
    with writing("--out", request.out):
        log = SessionLog(request.out / COMMISSIONING_RECORDING, world, request.bus, title)
    network = JournaledNetwork(world.link, world.clock, writes)
    session = Session(request, world, network, dialog, stop, sheet, log)
    result = Commissioned(findings=session.found, defect="an error of hil's own, see its traceback")
    chosen = list((steps or all_steps)())
    try:
        with writing("--out", request.out):
            run_sequence(session, chosen, result.records)
        result.defect = ""
    except BenchError as error:
        result.error, result.defect = error, ""
        log.event("CRITICAL", str(error))
    finally:
        try:
            _finish(session, result)
        finally:
            _end_log(session, result)
            _write(session, result)
    return result


def _finish(session: Session, result: Commissioned) -> None:
    """Finish on every way out; faults of bus or drive are noted, not raised."""
    network, journal, left = session.network, session.network.journal, result.left
    if journal is None:
        return
    session.found.settings = set_objects(session)
    session.found.originals = journal.contents.originals()
    left.changed = len({change.object for change in journal.contents.changes if change.new != change.old})
    left.enabled = session.configured
    left.host_watched = session.configured and not session.unwatched
    keeps = session.request.store and result.error is None
    ways = [_rest] if keeps and not session.request.brief else [_rest, _put_back]
    try:
        for leave in (*ways, _store) if keeps else ways:
            try:
                with writing("--out", session.request.out):
                    leave(session, left)
            except BenchError as failure:
                left.evidence = left.evidence or str(failure)
                session.log.event("CRITICAL", f"at the end: {failure}")
                if result.error is None or result.error.exit_status != PeerFault.exit_status:
                    result.error = failure
    finally:
        result.disturbances = session.drives.end()
        network.fall_silent()
        network.watch(session.request.node, Duration(0))
        with suppress(OSError):  # a line that found no room was told when it was written
            journal.close()


def _end_log(session: Session, result: Commissioned) -> None:
    restoration = result.left.restoration
    if restoration is not None and restoration.complete:
        session.log.event("INFO", f"{restoration.objects} objects hold again what they held before")
    for failure in [] if restoration is None else restoration.failures:
        session.log.event("ERROR", f"not put back: {failure}")
    if result.left.stored:
        session.log.event("INFO", "the settings were stored in the drive (1010h)")
    session.log.close()
    if session.log.failed:
        session.dialog.tell(f"the recording ends early: {session.log.failed}")


def _write(session: Session, result: Commissioned) -> None:
    """Write files and report, as far as there is room, and say how the drive was left."""
    request = session.request
    try:
        with writing("--out", request.out):
            if not (request.dry_run or request.brief):
                write_files(session)
    except (BadInput, DiskFull) as error:
        result.error = result.error or error
    for name, write in (("report", write_report), ("certificate", write_certificate)):
        if request.brief and name == "certificate":
            continue
        try:
            with writing("--out", request.out):
                write(request, result)
        except (BadInput, DiskFull) as error:
            result.error = result.error or error
            session.dialog.tell(f"the {name} is not whole: {error}")
    for sentence in result.left.sentences(request):
        session.dialog.tell(sentence)


def _rest(session: Session, left: DriveLeft) -> None:
    if not session.configured:
        return

    def note(drive: ServoDrive, release: Release) -> None:
        left.at_rest = release.at_rest or None
        left.disabled = (release.at_rest and release.state in DISABLED) or None
        left.evidence = release.evidence
        if release.unwatched:
            session.dialog.tell(f"{drive.name}: {release.unwatched}")
        if not release.at_rest:
            session.dialog.tell(f"the drive is not confirmed at rest: {release.evidence}")

    session.drives.let_go([session.drive], note, stopped=())  # each step has stopped it already


def _put_back(session: Session, left: DriveLeft) -> None:
    network, journal = session.network, session.network.journal
    assert journal is not None
    network.putting_back = True
    changes = [each for each in journal.contents.changes if each.object not in session.kept]
    left.restoration = restore(network, replace(journal.contents, changes=changes))
    left.at_rest = left.disabled = True
    left.kept = tuple(sorted(map(str, session.kept)))
    if left.restoration.complete and not left.kept:
        journal.note_restored()


def _store(session: Session, left: DriveLeft) -> None:
    try:
        store_settings(session.network, session.request.node)
    except PeerFault as error:
        left.not_stored = str(error)
        session.dialog.tell(
            f"the drive does not store: {error}; it keeps the settings until it is switched off"
        )
    else:
        left.stored = True
