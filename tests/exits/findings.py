"""What must be true of every cell, beside what must be true of every run."""

from collections.abc import Callable, Iterator
from typing import Final

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration
from servobench.hil.rows.run_files import EVENTS_FILE
from tests.exits.cells import BROKER, DRIVE, HOST, HUB, KILL, RUNNING
from tests.exits.one_run import STOPPED_NS, Ended
from tests.swarm.following import the_shafts_are_at_rest_at_the_end
from tests.swarm.invariants import broken, lost_max

REST_MAX: Final = Duration(NS_PER_S)
"""0.5 s until a drive misses its host (any_bus.toml), 0.1 s of quick stop, and what two shared cores take."""


def ended_as_documented(ended: Ended) -> Iterator[str]:
    """A documented status; the host itself lives unless it is killed."""
    if ended.struck_at is None:
        yield f"the run never came to the phase: status {ended.ran.case.status}, {ended.ran.case.said[-400:]}"
    if ended.ran.survived is _host_killed(ended):
        yield f"the host's process ended with {ended.ran.case.status}"
    told = ended.ran.told["verdict"]["exit_status"]
    if told not in ended.ran.statuses:
        yield f"told as {told}: {ended.ran.told['verdict']['reason']}"


def the_drive_rests(ended: Ended) -> Iterator[str]:
    """One that is left on a bus; soon, where nobody commands it any more."""
    cell = ended.cell
    if _drive_is_gone(ended):
        return
    if ended.rest is None:
        yield f"never at rest: {ended.ran.case.drives[0].states[-4:]}"
    elif _host_killed(ended) and ended.rest > REST_MAX:
        yield f"at rest after {ended.rest / NS_PER_MS:.0f} ms only"
    elif cell.phase == RUNNING and cell.deed == "stop" and cell.victim == HOST and ended.rest > STOPPED_NS:
        yield "it turned as long as its host was away"


def little_is_lost(ended: Ended) -> Iterator[str]:
    """Of a killed host what it had not made a row of yet; else nothing, or the recording says so."""
    config = ended.ran.config
    owed = lost_max(config) // config.loop.period if _host_killed(ended) else 0
    if ended.lost > owed and not ended.rows_told_lost:
        yield f"{ended.lost} rows lost"


def lines_are_whole(ended: Ended) -> Iterator[str]:
    """Of what is written line by line."""
    for name in (EVENTS_FILE,):
        path = ended.ran.folder / name
        if path.exists() and path.read_bytes()[-1:] not in (b"", b"\n"):
            yield f"{name} ends in the middle of a line"


def _drive_is_gone(ended: Ended) -> bool:
    """Its process has ended with the victim, before the shaft had come to rest."""
    cell = ended.cell
    return (cell.victim in (BROKER, DRIVE) and cell.deed != "stop") or (
        cell.bus != HUB and _host_killed(ended)
    )


def _host_killed(ended: Ended) -> bool:
    return ended.cell.victim == HOST and ended.cell.deed == KILL


Invariant = Callable[[Ended], Iterator[str]]
INVARIANTS: Final[tuple[Invariant, ...]] = (
    ended_as_documented,
    the_drive_rests,
    little_is_lost,
    lines_are_whole,
)


def findings(ended: Ended) -> list[str]:
    """What a cell does not hold, by name."""
    own = [f"{invariant.__name__}: {text}" for invariant in INVARIANTS for text in invariant(ended)]
    of_run = broken(ended.ran)
    if _drive_is_gone(ended):
        at_rest = the_shafts_are_at_rest_at_the_end.__name__
        of_run = [text for text in of_run if not text.startswith(at_rest)]
    return [*own, *of_run]
