"""What must be true of every run, whatever befell it, each with how a run is held against it."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from can.io.canutils import CanutilsLogReader

from drivers.profile402 import State
from drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from hil.configuration.config import BenchConfig
from hil.recording.records import ROW_DTYPE, Rows
from hil.recording.records_file import RECORDS_FILE, read_metadata, read_records
from hil.recording.run_metadata import FIRST_CYCLE
from hil.testing.wire import read_wire
from tests.swarm.witness import EMCY_ID, DriveHistory

STATUSES: Final = (0, 1, 3, 4, 5, 6)
"""docs/verdict.md; a drawn bench is never bad input, and nobody interrupts it."""
REST_RAD_S: Final = 1.0
EMCY_WITHIN_NS: Final = NS_PER_MS
TELLING_NS: Final = NS_PER_MS
"""What is told at the very end has no frame of its own."""


@dataclass(frozen=True)
class Ran:
    """A case that was run, with its recording and its witnesses."""

    config: BenchConfig
    folder: Path
    status: int
    out: str
    said: str
    drives: Sequence[DriveHistory]
    statuses: Sequence[int] = STATUSES
    """With which it may have ended."""
    telling_ns: int = TELLING_NS

    @cached_property
    def told(self) -> dict[str, Any]:
        """The object of --json."""
        found: dict[str, Any] = json.loads(self.out)
        return found

    @cached_property
    def rows(self) -> Rows:
        """(n,) of all axes; none where the run never began."""
        if not (self.folder / RECORDS_FILE).exists():
            return np.empty(0, ROW_DTYPE)
        return np.concatenate([np.empty(0, ROW_DTYPE), *read_records(self.folder / RECORDS_FILE)])

    @cached_property
    def events(self) -> list[dict[str, Any]]:
        """Of events.jsonl."""
        lines = (self.folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines]

    @cached_property
    def first_cycle(self) -> int:
        """On the clock of the bench, and so of the drives' witnesses, ns."""
        return int(read_metadata(self.folder / RECORDS_FILE)[FIRST_CYCLE])

    @property
    def planned(self) -> int:
        """Cycles of each axis."""
        return -(-round(self.config.bench.duration_s * NS_PER_S) // self.config.loop.period)


def one_object_that_tells_the_status(ran: Ran) -> Iterator[str]:
    """A documented status, one object on stdout with the same in it, the same again in summary.json."""
    if ran.status not in ran.statuses:
        yield f"status {ran.status}: {ran.said[-400:]}"
    if ran.told["verdict"]["exit_status"] != ran.status:
        yield f"status {ran.status}, the object says {ran.told['verdict']['exit_status']}"
    summary = ran.folder / "summary.json"
    if not summary.exists() or json.loads(summary.read_text(encoding="utf-8")) != ran.told:
        yield "summary.json is not the object that was printed"


def every_planned_cycle_has_one_row(ran: Ran) -> Iterator[str]:
    """Numbers from 1 without a gap, no more than planned; all of them in a run that was completed."""
    verdict = ran.told["verdict"]
    for axis, name in enumerate(ran.config.axes):
        numbers = np.sort(ran.rows["sequence"][ran.rows["axis"] == axis])
        if not np.array_equal(numbers, np.arange(1, numbers.size + 1)):
            yield f"{name}: rows are missing or double"
        if numbers.size > ran.planned:
            yield f"{name}: {numbers.size} rows of {ran.planned} planned cycles"
        if numbers.size < ran.planned and (verdict["completed"] or verdict["passed"]):
            yield f"{name}: completed with {numbers.size} rows of {ran.planned}"


def counts_are_those_of_the_rows(ran: Ran) -> Iterator[str]:
    """Used, lost, late, stale and missed make up all rows."""
    fates = np.bincount(ran.rows["fate"], minlength=5)
    told = ran.told["dropouts"]
    counted = [told[cause] for cause in ("lost", "late", "stale", "missed")]
    if fates[1:].tolist() != counted:
        yield f"dropouts told {counted}, in the rows {fates[1:].tolist()}"


def completed_means_enabled_throughout(ran: Ran) -> Iterator[str]:
    """By the drives themselves, from the first cycle to the last."""
    if not ran.told["verdict"]["completed"]:
        return
    due_at = ran.rows["due_at"] + ran.first_cycle
    for drive in ran.drives:
        if not drive.enabled_throughout(Instant(int(due_at.min())), Instant(int(due_at.max()))):
            yield f"completed, and node {drive.node_id} was in {drive.states[-6:]}"


def passed_means_at_rest_and_without_emergency(ran: Ran) -> Iterator[str]:
    """By the drives themselves, when all is over."""
    told = {end["name"]: end["at_rest"] for end in ran.told.get("drives", ())}
    for name, drive in zip(ran.config.axes, ran.drives, strict=True):
        resting = abs(drive.speed_rad_s) < REST_RAD_S and drive.states[-1][1] is not State.OPERATION_ENABLED
        if told.get(name) and not resting:
            yield f"{name}: told at rest, and at {drive.speed_rad_s:.1f} rad/s in {drive.states[-1][1]}"
        if ran.told["verdict"]["passed"] and not told.get(name):
            yield f"{name}: passed, and its rest was not read"


def nothing_is_told_that_has_not_happened(ran: Ran) -> Iterator[str]:
    """No event lies behind the last frame, or behind the beginning of a stopping that no frame answers."""
    ends = [frame.at for frame in read_wire(ran.folder).frames[-1:]]
    ends += [event["at_ns"] for event in ran.events if event.get("state") == "stopping"]
    late = [event for event in ran.events if ends and event["at_ns"] > max(ends) + ran.telling_ns]
    if late:
        yield f"events after the end, {max(ends)}: {late[:3]}"


def frames_are_in_order_of_time(ran: Ran) -> Iterator[str]:
    """As python-can reads them."""
    with CanutilsLogReader(ran.folder / "frames.log") as log:
        stamps = [message.timestamp for message in log]
    if stamps != sorted(stamps):
        yield "frames.log goes back in time"


def emergencies_are_told_when_they_were_sent(ran: Ran) -> Iterator[str]:
    """Each that came to the host is an event, or the end of the run, with the instant of its frame."""
    frames = read_wire(ran.folder).frames
    came = [
        frame
        for frame in frames
        if not frame.sent and EMCY_ID < frame.can_id < EMCY_ID + 0x80 and any(frame.data[:2])
    ]
    told = [event["at_ns"] for event in ran.events if "EMCY" in event.get("text", "")]
    for frame in came:
        if not any(abs(frame.at - at) <= EMCY_WITHIN_NS for at in told):
            yield f"EMCY of node {frame.can_id - EMCY_ID} at {frame.at} is no event; told: {told}"


Invariant = Callable[[Ran], Iterator[str]]
OF_ROWS: Final[tuple[Invariant, ...]] = (
    every_planned_cycle_has_one_row,
    counts_are_those_of_the_rows,
    completed_means_enabled_throughout,
)
INVARIANTS: Final[tuple[Invariant, ...]] = (
    one_object_that_tells_the_status,
    passed_means_at_rest_and_without_emergency,
    nothing_is_told_that_has_not_happened,
    frames_are_in_order_of_time,
    emergencies_are_told_when_they_were_sent,
)


def broken(ran: Ran, of_rows: Sequence[Invariant] = OF_ROWS) -> list[str]:
    """What a run does not hold, by name; ``of_rows``: none where the rows are told to be missing."""
    return [f"{held.__name__}: {text}" for held in (*INVARIANTS, *of_rows) for text in held(ran)]
