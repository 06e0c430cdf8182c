"""The fate of every frame under a fault plan: pure, seeded, the same on every machine.

A link is one direction of the traffic of one node; frames of no single node (SYNC, NMT, TIME)
form a link of their own. Each fault has its own random stream on each link, and each stream
moves on by every frame that the fault selects, in its window or not, lost by another fault or
not. So a change of one fault never shifts the draws of another.
"""

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.identifiers import EXTENDED_FLAG, STANDARD_ID_MAX
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.fates import FateSource, Route
from servobench.virtual_bus.faults.fault_log import FaultLog
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.frame_fault import FrameFault, node_of
from servobench.virtual_bus.faults.strikes import Hold, Strike


class FaultInjector(FateSource):
    """Applies ``plan`` with the random streams of ``seed``; ``link`` tells the buses of a bench and the
    connections to them apart; ``node``: see :class:`FateSource`.

    ``error_frames``: the bus itself can disturb a frame on the wire, so the corruptions with that effect are
    left to it (:mod:`servobench.virtual_bus.faults.disturber`); without, such a frame is lost.
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
