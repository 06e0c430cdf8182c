"""A whole commissioning: from the first frame to the files, and back to how the drive was found."""

from collections.abc import Callable, Sequence

from drivers.canopen.objects301 import Cia301
from drivers.errors import BenchError, PeerFault
from drivers.sheets.dictionary import LoadedDictionary
from drivers.timebase import NS_PER_MS, NS_PER_S, Duration
from hil.commissioning.dialog import Dialog, EmergencyStop
from hil.commissioning.files import set_objects, write_files
from hil.commissioning.recording import SessionLog
from hil.commissioning.report import Commissioned, write_report
from hil.commissioning.request import CommissionRequest
from hil.commissioning.sequence import Step, run_sequence
from hil.commissioning.session import Session
from hil.commissioning.steps import all_steps
from hil.execution.world import World
from hil.restoring.journaled import JournaledNetwork
from hil.restoring.restore import restore
from hil.rows.run_files import COMMISSIONING_RECORDING

SAVE: bytes = b"save"
"""Signature that 1010h wants (CiA 301 7.5.2.13)."""
_STORE_LIMIT = Duration(2 * NS_PER_S)


def commission(
    request: CommissionRequest,
    world: World,
    dialog: Dialog,
    stop: EmergencyStop,
    sheet: LoadedDictionary | None = None,
    steps: Callable[[], Sequence[Step]] | None = None,
) -> Commissioned:
    """Run the sequence. Whatever happens, the drive is brought to rest and put back before this returns.

    Raises only what keeps it from being put back: BusDown, NoAnswer. The journal then has everything.
    """
    request.out.mkdir(parents=True, exist_ok=True)
    title = f"commissioning of node {request.node} on {request.bus}"
    log = SessionLog(request.out / COMMISSIONING_RECORDING, world, request.bus, title)
    network = JournaledNetwork(world.link, world.clock)
    session = Session(request, world, network, dialog, stop, sheet, log)
    result = Commissioned(findings=session.found)
    chosen = list((steps or all_steps)())
    try:
        try:
            run_sequence(session, chosen, result.records)
        except BenchError as error:
            result.error = error
            log.event("CRITICAL", str(error))
            raise
        finally:
            try:
                _finish(session, result)
            finally:
                _end_log(session, result)
    except BenchError as error:
        if error is not result.error:
            raise
    if not request.dry_run:
        write_files(session)
    write_report(session, result)
    return result


def _finish(session: Session, result: Commissioned) -> None:
    """Every way out leads through here."""
    network, journal = session.network, session.network.journal
    if journal is None:
        return
    session.found.settings = set_objects(session)
    session.found.originals = journal.contents.originals()
    try:
        if session.configured:
            _rest(session)
        if session.request.store and result.error is None:
            _store(session, result)
        else:
            network.putting_back = True
            result.restoration = restore(network, journal.contents)
            if result.restoration.complete:
                journal.note_restored()
    finally:
        session.guard.end(session.clock_now)
        network.fall_silent()
        network.watch(session.request.node, Duration(0))
        journal.close()
        put_back = result.restoration is not None and result.restoration.complete
        if not (put_back or result.stored):
            session.dialog.tell(f"not everything is as it was: {session.request.restore_command}")


def _end_log(session: Session, result: Commissioned) -> None:
    restoration = result.restoration
    if restoration is not None and restoration.complete:
        session.log.event("INFO", f"{restoration.objects} objects hold again what they held before")
    for failure in [] if restoration is None else restoration.failures:
        session.log.event("ERROR", f"not put back: {failure}")
    if result.stored:
        session.log.event("INFO", "the settings were stored in the drive (1010h)")
    session.log.close()
    if session.log.failed:
        session.dialog.tell(f"the recording ends early: {session.log.failed}")


def _rest(session: Session) -> None:
    release = session.drive.release()
    if release.unwatched:
        session.dialog.tell(f"{session.drive.name}: {release.unwatched}")
    if not release.at_rest:
        session.dialog.tell(f"the drive is not confirmed at rest: {release.evidence}")


def _store(session: Session, result: Commissioned) -> None:
    """Have the drive keep what was set, 1010h:1."""
    network, node = session.network, session.request.node
    before = network.sdo_timeout_s
    network.sdo_timeout_s = _STORE_LIMIT / NS_PER_S
    try:
        network.download(node, Cia301.STORE_PARAMETERS, 1, SAVE)
    except PeerFault as error:
        result.not_stored = str(error)
        session.dialog.tell(
            f"the drive does not store: {error}; it keeps the settings until it is switched off"
        )
    else:
        result.stored = True
    finally:
        network.sdo_timeout_s = before
    network.pump(network.deadline_after(Duration(50 * NS_PER_MS)))
