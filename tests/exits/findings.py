"""What must be true of every cell, beside what must be true of every run."""

from collections.abc import Callable, Iterator
from typing import Final

from drivers.profile402 import State
from drivers.timebase import NS_PER_MS, NS_PER_S, Duration
from hil.attribution import HELD_MAX
from hil.recording.records_file import RECORDS_FILE
from hil.recording.run_folder import EVENTS_FILE, FRAMES_FILE
from hil.verdict import ExitStatus
from tests.exits.cells import BROKER, DRIVE, HOST, HUB, KILL, RUNNING
from tests.exits.one_run import STOPPED_NS, Ended
from tests.swarm.invariants import OF_ROWS, broken

REST_MAX: Final = Duration(NS_PER_S)
"""0.5 s until a drive misses its host (any_bus.toml), 0.1 s of quick stop, and what two shared cores take."""
LOST_MAX: Final = HELD_MAX + 1
"""A host's rows wait so many cycles at most for what may still become known of their readings."""


def ended_as_documented(ended: Ended) -> Iterator[str]:
    """The host's own status, where it was not killed."""
    if ended.struck_at is None:
        yield f"the run never came to the phase: status {ended.status}, {ended.remains.said[-400:]}"
    if ended.status != ended.remains.status and not _host_killed(ended):
        yield f"status {ended.status}"


def the_drive_rests(ended: Ended) -> Iterator[str]:
    """One that is left on a bus; soon, where nobody commands it any more."""
    cell = ended.cell
    if (cell.victim in (BROKER, DRIVE) and cell.deed != "stop") or (cell.bus != HUB and _host_killed(ended)):
        return
    if ended.rest is None:
        yield f"never at rest: {ended.remains.drives[0].states[-4:]}"
    elif _host_killed(ended) and ended.rest > REST_MAX:
        yield f"at rest after {ended.rest / NS_PER_MS:.0f} ms only"
    elif cell.phase == RUNNING and cell.deed == "stop" and cell.victim == HOST and ended.rest > STOPPED_NS:
        yield "it turned as long as its host was away"


def little_is_lost(ended: Ended) -> Iterator[str]:
    """Of a killed host what it had not made a row of yet; else nothing, or the recording says so."""
    if ended.lost > (LOST_MAX if _host_killed(ended) else 0) and not ended.rows_told_lost:
        yield f"{ended.lost} rows lost"


def nothing_is_told_of_after_a_kill(ended: Ended) -> Iterator[str]:
    """A killed host lists no event of later."""
    if _host_killed(ended) and ended.struck_at is not None:
        killed_at = ended.struck_at - ended.remains.first_cycle
        late = [event for event in ended.remains.events if event["at_ns"] > killed_at + NS_PER_MS]
        if late:
            yield f"events after the kill at {killed_at}: {late[:3]}"


def nothing_moves_unrecorded(ended: Ended) -> Iterator[str]:
    """Where the recorder could not even begin."""
    (drive,) = ended.remains.drives
    if any(state is State.OPERATION_ENABLED for _, state in drive.states):
        yield "the drive was enabled, and there is no record of it"
    if ended.remains.told["verdict"]["exit_status"] != ExitStatus.NOT_RECORDED:
        yield f"told as {ended.remains.told['verdict']['outcome']}"


def lines_are_whole(ended: Ended) -> Iterator[str]:
    """Of what is written line by line."""
    for name in (EVENTS_FILE, FRAMES_FILE):
        path = ended.remains.folder / name
        if not path.exists() or path.read_bytes()[-1:] not in (b"", b"\n"):
            yield f"{name} ends in the middle of a line"


def _host_killed(ended: Ended) -> bool:
    return ended.cell.victim == HOST and ended.cell.deed == KILL


Invariant = Callable[[Ended], Iterator[str]]
UNRECORDED: Final[tuple[Invariant, ...]] = (ended_as_documented, the_drive_rests)
INVARIANTS: Final[tuple[Invariant, ...]] = (
    *UNRECORDED,
    little_is_lost,
    nothing_is_told_of_after_a_kill,
    lines_are_whole,
)


def findings(ended: Ended) -> list[str]:
    """What a cell does not hold, by name."""
    recorded = (ended.remains.folder / RECORDS_FILE).exists()
    invariants = INVARIANTS if recorded else (*UNRECORDED, nothing_moves_unrecorded)
    own = [f"{invariant.__name__}: {text}" for invariant in invariants for text in invariant(ended)]
    if not recorded:
        return own
    return [*own, *broken(ended.remains, () if ended.rows_told_lost else OF_ROWS)]
