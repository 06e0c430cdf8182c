"""The fate of every frame under a fault plan: pure, seeded, the same on every machine.

A link is one direction of the traffic of one node; frames of no single node (SYNC, NMT, TIME)
form a link of their own. Each fault has its own random stream on each link, and each stream
moves on by every frame that the fault selects, in its window or not, lost by another fault or
not. So a change of one fault never shifts the draws of another.

Corruption on the wire: which attempts to send a frame are disturbed, and at which bit.

For a segment with error frames; the sender then repeats the frame by itself. Every attempt is judged,
so at a probability p a frame takes 1 / (1 - p) attempts in the mean.
"""

from collections.abc import Callable

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import EXTENDED_FLAG, STANDARD_ID_MAX
from servobench.virtual_bus.bus.disturbance import Disturbance
from servobench.virtual_bus.bus.frame_image import frame_bits
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.fates import FateSource, RecordedFaults, Route
from servobench.virtual_bus.faults.fault_log import KIND_CODES, FaultLog
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.frame_fault import FrameFault, Hold, NumberedStrike, Strike, node_of
from servobench.virtual_bus.faults.kinds.corruption import ERROR_FRAME, Corruption
from servobench.virtual_bus.frame import Frame

_ERROR_FRAME = KIND_CODES[ERROR_FRAME]

BitOf = Callable[[Direction, Frame, int, int], int | None]
"""Which bit of a frame that begins on the bus is disturbed; None: none. It is the n-th attempt (from 0) with
its identifier in its direction, so long after time zero, ns."""


def _key(frame: Frame) -> int:
    return frame.can_id | EXTENDED_FLAG if frame.extended else frame.can_id


def _drawn_bits(plan: FaultPlan, seed: int, link: str = "bus") -> BitOf | None:
    """By the corruptions of a plan with the effect ``error_frame``; None if it has none."""
    all_of_kind = [fault for fault in plan.faults if isinstance(fault, Corruption)]
    faults = [
        (place, each) for place, each in enumerate(all_of_kind) if each.on_the_wire and each.probability
    ]
    routes: dict[tuple[Direction, int], list[NumberedStrike]] = {}
    strikes: dict[str, NumberedStrike] = {}

    def route(direction: Direction, frame: Frame) -> list[NumberedStrike]:
        routed = []
        for place, fault in faults:
            if fault.selects(direction, frame.can_id, frame.extended):
                node = node_of(frame.can_id, frame.extended)
                name = f"{link}/{direction.label}/{node}/{fault.kind}/{place}"
                if name not in strikes:
                    strikes[name] = fault.at_work(UniformStream(seed, name))
                routed.append(strikes[name])
        return routed

    def bit_of(direction: Direction, frame: Frame, n: int, elapsed_ns: int) -> int | None:  # noqa: ARG001
        key = direction, _key(frame)
        if key not in routes:
            routes[key] = route(direction, frame)
        # Each draws for every attempt; the first that strikes counts.
        struck = [strike for strike in routes[key] if strike.strikes(elapsed_ns)]
        return int(struck[0].value * frame_bits(frame)) if struck else None

    return bit_of if faults else None


def _recorded_bits(recorded: RecordedFaults) -> BitOf | None:
    """The error frames of a recorded run; None if it has none."""
    bits = {
        (entry.link, entry.can_id, entry.n): entry.a
        for entry in recorded.entries
        if entry.code == _ERROR_FRAME
    }
    return (lambda way, frame, n, _: bits.get((int(way), _key(frame), n))) if bits else None


class Disturber:
    """Between a segment and what decides: counts the attempts, and enters what it disturbs in ``log``."""

    def __init__(self, bit_of: BitOf, log: FaultLog | None, is_host: Callable[[str], bool]) -> None:
        """``is_host``: whether the port of that name sends from host to drive."""
        self.disturbed = {way.label: 0 for way in Direction}
        self._bit_of = bit_of
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
        """Decide for ``CanSegment.set_disturb`` of the bus: every node sees the disturbed bit."""
        if self._zero is None:
            return None
        direction = Direction.HOST_TO_DRIVE if self._is_host(sender) else Direction.DRIVE_TO_HOST
        key = _key(frame)
        n = self._attempts.get((direction, key), 0)
        self._attempts[direction, key] = n + 1
        elapsed = at - self._zero
        bit = self._bit_of(direction, frame, n, elapsed)
        if bit is None:
            return None
        self.disturbed[direction.label] += 1
        if self._log is not None:
            self._log.note(_ERROR_FRAME, elapsed, direction, key, n, bit)
        return Disturbance(bit)


def disturber(
    faults: FaultPlan | RecordedFaults, seed: int, log: FaultLog | None, is_host: Callable[[str], bool]
) -> Disturber | None:
    """Return the disturber of a segment by ``faults``; None if nothing disturbs it."""
    bit_of = _drawn_bits(faults, seed) if isinstance(faults, FaultPlan) else _recorded_bits(faults)
    return None if bit_of is None else Disturber(bit_of, log, is_host)


class FaultInjector(FateSource):
    """Applies ``plan`` with the random streams of ``seed``; ``link`` tells the buses of a bench and the
    connections to them apart; ``node``: see :class:`FateSource`.

    ``error_frames``: the bus itself can disturb a frame on the wire, so the corruptions with that effect are
    left to it (:mod:`servobench.virtual_bus.faults.fault_injector`); without, such a frame is lost.
    """

    def __init__(
        self,
        plan: FaultPlan,
        seed: int,
        link: str = "bus",
        error_frames: bool = False,
        log: FaultLog | None = None,
        node: int = 0,
    ) -> None:
        faults = plan.faults
        explicit = frozenset(
            item | EXTENDED_FLAG
            for fault in faults
            for item in fault.frames
            if isinstance(item, int) and item > STANDARD_ID_MAX
        )
        super().__init__([fault.kind for fault in faults if not fault.delays], explicit, log, node)
        self._error_frames = error_frames
        self._faults = faults
        self._seed = seed
        self._link = link
        self._at_work: dict[tuple[int, int, int], Strike | Hold] = {}

    def start(self, now: Instant) -> None:
        """See :class:`FateSource`; every stream begins anew."""
        super().start(now)
        self._at_work = {}

    def route(self, way: int, can_id: int, extended: bool) -> Route:
        """See :class:`FateSource`."""
        direction, node = Direction(way), node_of(can_id, extended)
        ranked: list[tuple[int, int, Strike]] = []
        holds: list[Hold] = []
        for index, fault in enumerate(self._faults):
            left_to_bus = fault.on_the_wire and self._error_frames
            if left_to_bus or not fault.selects(direction, can_id, extended):
                continue
            at_work = self._make(index, fault, direction, node)
            if isinstance(at_work, Hold):
                holds.append(at_work)
            else:
                ranked.append((fault.rank, index, at_work))
        in_order = bool(holds) and all(hold.in_order for hold in holds)
        queue = self.queue(way, can_id, extended) if in_order else None
        in_rank = sorted(ranked, key=lambda each: each[:2])
        return Route(queue, [strike for _, _, strike in in_rank], holds)

    def _make(self, index: int, fault: FrameFault, direction: Direction, node: int) -> Strike | Hold:
        key = index, int(direction), node
        at_work = self._at_work.get(key)
        if at_work is None or fault.of_each_cob_id:
            # Named by the fault's place among its own kind: those of other kinds do not count.
            place = sum(other.kind == fault.kind for other in self._faults[:index])
            name = f"{self._link}/{direction.label}/{node}/{fault.kind}/{place}"
            at_work = self._at_work[key] = fault.at_work(UniformStream(self._seed, name))
        return at_work
