"""What must be true of runs whose drives do something else than they are asked for.

Witnesses are the drives themselves, and the frames on the wire with mappings that are learnt from the wire.
"""

from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

from servobench.drivers.cia402.profile import STATE_BITS, STATUS_PATTERNS, Mode, State, Status
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.testing.wire import SeenFrame
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.mapped_objects import SeenMappings
from servobench.virtual_bus.frame import Frame
from tests.swarm.ran import Ran
from tests.swarm.witness import FAR_TORQUE, OTHER_MODE, OTHER_TORQUE, TARGET_IGNORED

CYCLES_MAX: Final = 3
"""From the frame that tells it to the reaction."""
POLLED_NS: Final = 60 * NS_PER_MS
"""6061h that is not mapped is read every 50 ms: a shorter time in another mode may go by unseen."""
LAPSES: Final = ("left cyclic synchronous torque", "ignores the commands")
"""How the bench says that a drive does not follow."""
HARMLESS: Final = ("repeated_emergency", "refused_mapping", "clock_step")
"""Kinds that keep no drive from following and no frame from coming."""
OTHERWISE: Final = ("mode_change", "ignored_commands")
TOLD_SIGNALS: Final = ("statusword", "modes_of_operation_display", "target_torque")
_STATUSWORD, _MODE, _CONTROLWORD, _DEMAND = 0x604100, 0x606100, 0x604000, 0x607400
_ENABLED: Final = STATUS_PATTERNS[State.OPERATION_ENABLED].value
_ENABLE_WORD: Final = 0x000F


class Shown(NamedTuple):
    """What came to the host of one drive, and when."""

    at: Instant
    follows: bool


def kinds(ran: Ran) -> set[str]:
    """Of the faults of the plan."""
    return set(_plan(ran))


def _plan(ran: Ran) -> dict[str, list[dict[str, Any]]]:
    faults = ran.config.faults
    return faults.as_tables() if isinstance(faults, FaultPlan) else {}


def _within(ran: Ran) -> tuple[Instant, Instant]:
    """First and last cycle, on the clock of the drives' witnesses; the same instant twice without any."""
    if not ran.rows.size:
        return Instant(0), Instant(0)
    due_at = ran.rows["due_at"] + ran.first_cycle
    return Instant(int(due_at.min())), Instant(int(due_at.max()))


def _stops(ran: Ran) -> bool:
    return ran.config.guard.on_mode == "stop"


def _frames_may_fail(ran: Ran) -> bool:
    """Something else than a drive that does otherwise may keep frames, or what they say, from the host."""
    signals = {each["object"] for each in _plan(ran).get("signal", ())}
    others = kinds(ran) - {*HARMLESS, *OTHERWISE, "signal"}
    return bool(others or signals & set(TOLD_SIGNALS) or ran.circumstances.strangers)


def no_run_passes_whose_drive_did_not_follow(ran: Ran) -> Iterator[str]:
    """By the drive's own state: in another mode, with its target ignored and bit 12 at 0; or with another
    torque than it was asked for, for longer than that may go unseen. With ``on_mode = "tell"`` it goes on,
    and has not passed all the same."""
    verdict, (first, last) = ran.told["verdict"], _within(ran)
    if not (verdict["passed"] or (verdict["completed"] and _stops(ran))) or _frames_may_fail(ran):
        return
    period = ran.config.loop.period
    for name, drive in zip(ran.config.axes, ran.case.drives, strict=True):
        until = Instant(last - CYCLES_MAX * period)
        told = drive.astray(first, until, OTHER_MODE, TARGET_IGNORED)
        refused = _plan(ran).get("refused_mapping", ())
        if any(map(_touches_mode, refused)) or not _tells(ran.wire.frames, drive.node_id, _MODE):
            told = _longer(drive.astray(first, until, OTHER_MODE), POLLED_NS)
            synced_ns = ran.config.loop.position_every_cycles * period
            told += _longer(drive.astray(first, until, TARGET_IGNORED), synced_ns)
        unseen_max = _unseen_max(ran, name)
        silent = _longer(drive.astray(first, last, OTHER_TORQUE, FAR_TORQUE), unseen_max)
        if silent and not _tells(ran.wire.frames, drive.node_id, _DEMAND):
            silent = _longer(drive.astray(first, last, FAR_TORQUE), unseen_max)
        if told or silent:
            yield f"{name}: {verdict['outcome']}, and it did otherwise at {(told or silent)[:3]}"


def _touches_mode(refusal: dict[str, Any]) -> bool:
    """Of the TPDO for 6061h, and for 6041h on change: 6041h comes with the SYNCs alone then."""
    return refusal.get("mapped") == "6061" or str(refusal.get("parameter", "")).startswith("1A02")


def _longer(spans: list[tuple[Instant, Instant]], least_ns: int) -> list[tuple[Instant, Instant]]:
    return [(begin, end) for begin, end in spans if end - begin > least_ns]


def _unseen_max(ran: Ran, name: str) -> int:
    """How long a drive may not follow, and nobody knows, ns: T of docs/timing.md, a tenth, and CYCLES_MAX."""
    host, period = ran.config.host, ran.config.loop.period
    dropouts_ns = ran.config.drive[name].limits.dropouts_consecutive_max * period
    heartbeat_ns, timeout_ns = host.heartbeat_ms * NS_PER_MS, host.heartbeat_timeout_ms * NS_PER_MS
    return 11 * min(timeout_ns, max(heartbeat_ns, dropouts_ns)) // 10 + CYCLES_MAX * period


def _tells(frames: list[SeenFrame], node: int, place: int) -> bool:
    """The object is in one of the drive's TPDOs. Without 6061h its mode is read now and then; without 6074h
    only a torque far from the set-point tells anything."""
    mappings = SeenMappings()
    for frame in frames:
        way = Direction.HOST_TO_DRIVE if frame.sent else Direction.DRIVE_TO_HOST
        if mappings.teaches(frame.can_id):
            mappings.watch(way, Frame(frame.can_id, frame.data))
        elif any(each.node == node and each.place == place for each in mappings.objects(way, frame.can_id)):
            return True
    return False


def a_drive_that_does_otherwise_is_stopped_within_three_cycles(ran: Ran) -> Iterator[str]:
    """From the first frame that tells it to the controlword that ends its enabling."""
    deceived = "host_stall" in kinds(ran) or ran.circumstances.strangers
    if deceived or not _stops(ran) or not ran.rows.size or not ran.whole:
        return
    limit, last_cycle = CYCLES_MAX * ran.config.loop.period, (ran.planned - 1) * ran.config.loop.period
    for name, drive in zip(ran.config.axes, ran.case.drives, strict=True):
        shown, stops = seen_on_the_wire(ran.wire.frames, drive.node_id)
        told = next((each.at for each in shown if not each.follows and 0 <= each.at < last_cycle), None)
        if told is None or any(0 <= at <= told for at in stops):
            continue
        stop = next((at for at in stops if at > told), None)
        if stop is None or stop - told > limit:
            yield f"{name}: told at {told}, and stopped at {stop}"


def seen_on_the_wire(frames: list[SeenFrame], node: int) -> tuple[list[Shown], list[Instant]]:
    """Whether the drive says that it follows, as often as that changes from the first time that it does; and
    when a controlword was sent that does not enable it."""
    mappings = SeenMappings()
    shown: list[Shown] = []
    stops: list[Instant] = []
    word = mode = None
    for frame in frames:
        way = Direction.HOST_TO_DRIVE if frame.sent else Direction.DRIVE_TO_HOST
        if frame.extended:
            continue
        if mappings.teaches(frame.can_id):
            mappings.watch(way, Frame(frame.can_id, frame.data))
            continue
        for place, first_bit, bits in (
            each[1:] for each in mappings.objects(way, frame.can_id) if each.node == node
        ):
            raw = int.from_bytes(frame.data, "little") >> first_bit & (1 << bits) - 1
            if first_bit + bits > 8 * len(frame.data):
                continue
            if place == _CONTROLWORD and raw & 0x8F != _ENABLE_WORD:
                stops.append(frame.at)
            word = raw if place == _STATUSWORD else word
            mode = raw if place == _MODE else mode
        follows = _follows(word, mode)
        if (
            follows is not None
            and (shown[-1].follows if shown else not follows) is not follows
            and (shown or follows)
        ):
            shown.append(Shown(frame.at, follows))
    return shown, stops


def _follows(word: int | None, mode: int | None) -> bool | None:
    """None: it is not enabled, or nothing was told."""
    if word is None or word & STATE_BITS != _ENABLED:
        return None
    ignored = not word & (Status.FOLLOWS_COMMAND | Status.INTERNAL_LIMIT_ACTIVE)
    return not ignored and mode in (None, Mode.CYCLIC_SYNCHRONOUS_TORQUE)


def no_run_is_ended_for_a_drive_that_follows(ran: Ran) -> Iterator[str]:
    """A wrong reading keeps no drive from following."""
    first, _ = _within(ran)
    if _frames_may_fail(ran):
        return
    astray = any(
        drive.astray(first, Instant(NS_PER_S << 20), OTHER_MODE, TARGET_IGNORED) for drive in ran.case.drives
    )
    said = [each["text"] for each in ran.events if any(part in each.get("text", "") for part in LAPSES)]
    if said and not astray:
        yield f"every drive followed, and it was said that {said[:2]}"


def the_shafts_are_at_rest_at_the_end(ran: Ran) -> Iterator[str]:
    """Where the commands came through to the end."""
    if kinds(ran) - {*HARMLESS, *OTHERWISE, "signal"} or ran.circumstances.strangers or not ran.survived:
        return
    for name, drive in zip(ran.config.axes, ran.case.drives, strict=True):
        if abs(drive.speed_rad_s) >= REST_RAD_S:
            yield f"{name}: at {drive.speed_rad_s:.1f} rad/s when all is over"


REST_RAD_S: Final = 1.0
OF_FOLLOWING: Final[tuple[Callable[[Ran], Iterator[str]], ...]] = (
    no_run_passes_whose_drive_did_not_follow,
    a_drive_that_does_otherwise_is_stopped_within_three_cycles,
    no_run_is_ended_for_a_drive_that_follows,
    the_shafts_are_at_rest_at_the_end,
)
