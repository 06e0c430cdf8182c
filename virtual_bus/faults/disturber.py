"""Corruption on the wire: which attempts to send a frame are disturbed, and at which bit.

For a segment with error frames; the sender then repeats the frame by itself. Every attempt is judged,
so at a probability p a frame takes 1 / (1 - p) attempts in the mean.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from drivers.timebase import Instant
from virtual_bus.bus.bit_length import frame_bits
from virtual_bus.bus.disturbance import Disturbance
from virtual_bus.faults.fault_log import EXTENDED_FLAG, KIND_CODES, FaultEntry, FaultLog
from virtual_bus.faults.fault_plan import Corruption, Direction, Effect, FaultPlan, node_of
from virtual_bus.faults.fault_streams import uniform_stream
from virtual_bus.faults.replay import RecordedFaults
from virtual_bus.faults.special_faults import Special
from virtual_bus.frame import Frame

_ERROR_FRAME = KIND_CODES["error_frame"]
FOREVER = 2**63 - 1


class Attempt(NamedTuple):
    """A frame begins on the bus."""

    direction: Direction
    frame: Frame
    key: int
    """Its identifier, with EXTENDED_FLAG."""
    n: int
    """How many attempts with this identifier in this direction there were since time zero."""
    elapsed_ns: int
    """Since time zero."""


class DisturbanceJudge(Protocol):
    """Says which bit of an attempt is disturbed, None: none."""

    def bit(self, attempt: Attempt) -> int | None: ...


class DrawnJudge:
    """Draws from the corruptions of a plan with the effect ``error_frame``."""

    def __init__(self, plan: FaultPlan, seed: int, link: str = "bus") -> None:
        all_of_kind = [fault for fault in plan.faults if isinstance(fault, Corruption)]
        self._faults = [
            (place, fault)
            for place, fault in enumerate(all_of_kind)
            if fault.effect is Effect.ERROR_FRAME and fault.probability > 0.0
        ]
        self._seed = seed
        self._link = link
        self._routes: dict[tuple[Direction, int], list[Special]] = {}
        self._specials: dict[tuple[Direction, int, int], Special] = {}

    @property
    def idle(self) -> bool:
        """It never disturbs anything."""
        return not self._faults

    def bit(self, attempt: Attempt) -> int | None:
        """See :class:`DisturbanceJudge`."""
        key = attempt.direction, attempt.key
        route = self._routes.get(key)
        if route is None:
            route = self._routes[key] = self._route(attempt)
        found = None
        for special in route:
            if special.strikes(attempt.elapsed_ns) and found is None:
                found = int(special.value * frame_bits(attempt.frame))
        return found

    def _route(self, attempt: Attempt) -> list[Special]:
        direction, frame = attempt.direction, attempt.frame
        node = node_of(frame.can_id, frame.extended)
        return [
            self._special(place, fault, direction, node)
            for place, fault in self._faults
            if fault.selection.selects(direction, frame.can_id, frame.extended)
        ]

    def _special(self, place: int, fault: Corruption, direction: Direction, node: int) -> Special:
        key = direction, node, place
        special = self._specials.get(key)
        if special is None:
            draw = uniform_stream(self._seed, f"{self._link}/{direction.label}/{node}/{fault.kind}/{place}")
            until = fault.selection.until_ns
            end = FOREVER if until is None else until
            special = self._specials[key] = Special(fault.kind, fault, fault.selection.from_ns, end, draw)
        return special


class ReplayedJudge:
    """The error frames of a recorded run."""

    def __init__(self, recorded: RecordedFaults) -> None:
        self._entries: dict[tuple[int, int, int], FaultEntry] = {
            (item.link, item.can_id, item.n): item for item in recorded.entries if item.code == _ERROR_FRAME
        }

    @property
    def idle(self) -> bool:
        """It never disturbs anything."""
        return not self._entries

    def bit(self, attempt: Attempt) -> int | None:
        """See :class:`DisturbanceJudge`."""
        entry = self._entries.get((int(attempt.direction), attempt.key, attempt.n))
        return None if entry is None else entry.a


class Disturber:
    """Between a segment and a judge: counts the attempts, and enters what it disturbs in ``log``."""

    def __init__(self, judge: DisturbanceJudge, log: FaultLog | None, is_host: Callable[[str], bool]) -> None:
        """``is_host``: whether the port of that name sends from host to drive."""
        self.disturbed = {way.label: 0 for way in Direction}
        self._judge = judge
        self._log = log
        self._is_host = is_host
        self._zero: Instant | None = None
        self._attempts: dict[tuple[Direction, int], int] = {}

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``; until then nothing is disturbed."""
        self._zero = now
        self._attempts.clear()

    def stop(self) -> None:
        """From here on nothing is disturbed."""
        self._zero = None

    def disturb(self, sender: str, frame: Frame, at: Instant) -> Disturbance | None:
        """What ``CanSegment.set_disturb`` of the bus asks: every node sees the disturbed bit."""
        bit = self.bit(sender, frame, at)
        return None if bit is None else Disturbance(bit)

    def bit(self, sender: str, frame: Frame, at: Instant) -> int | None:
        """The bit of the frame, counted from start of frame, at which the bus is disturbed."""
        if self._zero is None:
            return None
        direction = Direction.HOST_TO_DRIVE if self._is_host(sender) else Direction.DRIVE_TO_HOST
        key = frame.can_id | EXTENDED_FLAG if frame.extended else frame.can_id
        n = self._attempts.get((direction, key), 0)
        self._attempts[direction, key] = n + 1
        elapsed = at - self._zero
        bit = self._judge.bit(Attempt(direction, frame, key, n, elapsed))
        if bit is not None:
            self.disturbed[direction.label] += 1
            if self._log is not None:
                self._log.note(_ERROR_FRAME, elapsed, direction, key, n, bit)
        return bit


def disturber(
    faults: FaultPlan | RecordedFaults, seed: int, log: FaultLog | None, is_host: Callable[[str], bool]
) -> Disturber | None:
    """What disturbs a segment by ``faults``; None if nothing does."""
    judge = DrawnJudge(faults, seed) if isinstance(faults, FaultPlan) else ReplayedJudge(faults)
    return None if judge.idle else Disturber(judge, log, is_host)
