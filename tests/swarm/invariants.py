"""What must be true of every run, whatever befell it, each with how a run is held against it."""

import json
from collections.abc import Callable, Iterator, Sequence
from typing import Final

import numpy as np
from can.io.canutils import CanutilsLogReader

from servobench.drivers.cia402.profile import State
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.loop.stamp_attribution import REVOKED
from servobench.hil.rows.run_files import FRAMES_FILE, SUMMARY_FILE
from servobench.hil.testing.wire import SeenFrame
from tests.recorded_frames import candump
from tests.swarm.following import OF_FOLLOWING
from tests.swarm.mishaps import STRIKE, Mishap
from tests.swarm.ran import TELLING_NS, Ran
from tests.swarm.witness import EMCY_ID

REST_RAD_S: Final = 1.0
EMCY_WITHIN_NS: Final = NS_PER_MS
COMMANDS: Final = range(0x200, 0x280)
LEFTOVERS: Final = ("records.tail", "frames.tail", ".reserve", "summary.json.part", "records.arrow.part")
RECORDER_STRUCK: Final = (Mishap.LOGGER_KILLED, Mishap.LOGGER_DIES, Mishap.DISK_FULL)


def the_status_is_a_documented_one(ran: Ran) -> Iterator[str]:
    """And the object that is printed tells it."""
    status = ran.case.status
    if not ran.survived:
        return
    if status not in ran.statuses:
        yield f"status {status}: {ran.case.said[-400:]}"
    if ran.told["verdict"]["exit_status"] != status:
        yield f"status {status}, the object says {ran.told['verdict']['exit_status']}"


def summary_json_is_the_object(ran: Ran) -> Iterator[str]:
    """The one that was printed; also where others had to write it."""
    summary = ran.folder / SUMMARY_FILE
    if not ran.survived:
        if ran.case.recovered:
            yield f"hil recover: status {ran.case.recovered}: {ran.case.said[-400:]}"
        if not summary.exists():
            yield "the host was killed, and there is no summary.json"
        return
    if summary.exists() and json.loads(summary.read_text(encoding="utf-8")) != ran.told:
        yield "summary.json is not the object that was printed"
    if not summary.exists() and ran.circumstances.mishap not in RECORDER_STRUCK:
        yield "there is no summary.json"


def what_struck_the_recording_is_told(ran: Ran) -> Iterator[str]:
    """A logger that did not end by itself, a disk without room, a host that is gone: none of them passed."""
    verdict = ran.told["verdict"]
    struck = ran.case.logger_status == -STRIKE
    if struck and not any(each["outcome"] == "not recorded" for each in verdict["findings"]):
        yield f"the logger was killed, and the verdict is {verdict['findings']}"
    if verdict["passed"] and not ran.whole:
        yield f"passed, and the recording lacks {ran.told.get('recording_faults')}"
    if not ran.survived and (verdict["completed"] or verdict["exit_status"] in (0, 1)):
        yield f"the host was killed, and the verdict is {verdict}"


def lost_max(config: BenchConfig) -> Duration:
    """What may be missing before the host was killed: 200 ms, or the cycles whose readings may still come."""
    cycles = max(config.loop.horizon_periods, REVOKED) + 1
    return Duration(max(200 * NS_PER_MS, cycles * config.loop.period))


def a_host_that_is_killed_leaves_its_rows(ran: Ran) -> Iterator[str]:
    """All but the last cycles, if somebody was there to take them out of the ring.

    A loop that waits for an answer, or stops the drives, serves no cycle: it counts until its last command.
    """
    mine = ran.circumstances.mishap is Mishap.HOST_KILLED and not ran.survived
    if not mine or not ran.rows.size or any(event.get("state") == "stopping" for event in ran.events):
        return
    served = [frame.at for frame in ran.wire.frames if frame.sent and frame.can_id in COMMANDS]
    last = int(ran.rows["due_at"].max())
    if served and served[-1] - last > lost_max(ran.config):
        yield f"the last command is of {served[-1]}, and the last row of {last}"


def every_planned_cycle_has_one_row(ran: Ran) -> Iterator[str]:
    """Numbers from 1 without a gap, no more than planned; all of them in a run that was completed."""
    verdict = ran.told["verdict"]
    for axis, name in enumerate(ran.config.axes):
        numbers = np.sort(ran.rows["sequence"][ran.rows["axis"] == axis])
        if not np.array_equal(numbers, np.arange(1, numbers.size + 1)):
            yield f"{name}: rows are missing or double"
        if numbers.size > ran.planned:
            yield f"{name}: {numbers.size} rows of {ran.planned} planned cycles"
        if numbers.size < ran.planned and ((ran.has_all_rows and verdict["completed"]) or verdict["passed"]):
            yield f"{name}: completed with {numbers.size} rows of {ran.planned}"


def counts_are_those_of_the_rows(ran: Ran) -> Iterator[str]:
    """Used, lost, late, stale and missed make up all rows."""
    fates = np.bincount(ran.rows["fate"], minlength=5)
    told = ran.told["dropouts"]
    counted = [told[cause] for cause in ("lost", "late", "stale", "missed")]
    if ran.has_all_rows and fates[1:].tolist() != counted:
        yield f"dropouts told {counted}, in the rows {fates[1:].tolist()}"


def completed_means_enabled_throughout(ran: Ran) -> Iterator[str]:
    """By the drives themselves, from the first cycle to the last."""
    if not ran.told["verdict"]["completed"] or not ran.rows.size:
        return
    due_at = ran.rows["due_at"] + ran.first_cycle
    for drive in ran.case.drives:
        if not drive.enabled_throughout(Instant(int(due_at.min())), Instant(int(due_at.max()))):
            yield f"completed, and node {drive.node_id} was in {drive.states[-6:]}"


def passed_means_at_rest_and_without_emergency(ran: Ran) -> Iterator[str]:
    """By the drives themselves, when all is over."""
    told = {end["name"]: end["at_rest"] for end in ran.told.get("drives", ())}
    for name, drive in zip(ran.config.axes, ran.case.drives, strict=True):
        state = drive.states[-1][1]
        resting = abs(drive.speed_rad_s) < REST_RAD_S and state is not State.OPERATION_ENABLED
        if told.get(name) and not resting:
            yield f"{name}: told at rest, and at {drive.speed_rad_s:.1f} rad/s in {state}"
        if ran.told["verdict"]["passed"] and not told.get(name):
            yield f"{name}: passed, and its rest was not read"


def nothing_is_told_that_has_not_happened(ran: Ran) -> Iterator[str]:
    """No event lies behind the last frame, a stopping that no frame answers, or the host's death."""
    if not ran.whole and ran.survived:
        return
    ends = [frame.at for frame in ran.wire.frames[-1:]]
    ends += [event["at_ns"] for event in ran.events if event.get("state") == "stopping"]
    until = max(ends, default=0) + ran.telling_ns
    if ran.case.killed_at is not None:
        until = ran.case.killed_at - ran.first_cycle + TELLING_NS
    told = [event for event in ran.events if "begin" not in event]
    late = [event for event in told if event["at_ns"] > until]
    if late and (ends or not ran.survived):
        yield f"events after the end, {until}: {late[:3]}"


def frames_are_in_order_of_time(ran: Ran) -> Iterator[str]:
    """As python-can reads them; or the recording says that some came too late."""
    with CanutilsLogReader(candump(ran.folder)) as log:
        stamps = [message.timestamp for message in log]
    if stamps != sorted(stamps) and ran.whole:
        yield "the frames go back in time"


def emergencies_are_told_when_they_were_sent(ran: Ran) -> Iterator[str]:
    """The first of each that came to the host is an event with the instant of its frame.

    Of several segments a node is on one: what a foreign node says with its identifier on another is not its.
    """
    told = [event["at_ns"] for event in ran.events if "EMCY" in event.get("text", "")]
    seen: set[tuple[int, bytes]] = set()
    for frame in ran.wire.frames:
        what = (frame.can_id, frame.data[:2])
        mine = not frame.sent and len(frame.data) == 8 and 0 < frame.can_id - EMCY_ID < 0x80
        if not mine or frame.extended or not any(what[1]) or what in seen:
            continue
        seen.add(what)
        if ran.config.bus.segment and not _sent_by_the_drive(ran, frame):
            continue
        if ran.whole and not any(abs(frame.at - at) <= EMCY_WITHIN_NS for at in told):
            yield f"EMCY of node {frame.can_id - EMCY_ID} at {frame.at} is no event; told: {told}"


def _sent_by_the_drive(ran: Ran, frame: SeenFrame) -> bool:
    code = int.from_bytes(frame.data[:2], "little")
    return any(
        drive.node_id == frame.can_id - EMCY_ID and code in [sent for _, sent in drive.emergencies]
        for drive in ran.case.drives
    )


def nothing_is_left_over(ran: Ran) -> Iterator[str]:
    """A recording that has ended has its own files, and no others."""
    left = [name for name in LEFTOVERS if (ran.folder / name).exists()]
    if left and (ran.whole or not ran.survived):
        yield f"left over: {left}"
    log = ran.folder / "logger.log"
    if log.exists() and log.stat().st_size and ran.has_all_rows:
        yield f"the logger said: {log.read_text(errors='replace')[-400:]}"


Invariant = Callable[[Ran], Iterator[str]]
OF_RUNS: Final[tuple[Invariant, ...]] = (
    the_status_is_a_documented_one,
    what_struck_the_recording_is_told,
    a_host_that_is_killed_leaves_its_rows,
    every_planned_cycle_has_one_row,
    counts_are_those_of_the_rows,
    completed_means_enabled_throughout,
    passed_means_at_rest_and_without_emergency,
    nothing_is_told_that_has_not_happened,
    emergencies_are_told_when_they_were_sent,
    *OF_FOLLOWING,
)
OF_RECORDINGS: Final[tuple[Invariant, ...]] = (
    summary_json_is_the_object,
    frames_are_in_order_of_time,
    nothing_is_left_over,
)
"""They need its files."""


def broken(ran: Ran) -> list[str]:
    """What a recorded run does not hold, by name."""
    if not (ran.folder / FRAMES_FILE).exists():
        return [] if _ended_without_a_disk(ran) else ["there is no recording"]
    return held_against((*OF_RUNS, *OF_RECORDINGS), ran)


def held_against(invariants: Sequence[Invariant], ran: Ran) -> list[str]:
    """What a run does not hold of them, by name."""
    return [f"{invariant.__name__}: {text}" for invariant in invariants for text in invariant(ran)]


def _ended_without_a_disk(ran: Ran) -> bool:
    """There was no room to begin with, and nothing has moved."""
    enabled = any(state is State.OPERATION_ENABLED for drive in ran.case.drives for _, state in drive.states)
    return ran.circumstances.mishap is Mishap.DISK_FULL and ran.case.status in (3, 5) and not enabled
