"""The fate of every frame under a fault plan: pure, seeded, the same on every machine.

A link is one direction of the traffic of one node; frames of no single node (SYNC, NMT, TIME)
form a link of their own. Each fault has its own random stream on each link, and each stream
moves on by every frame that the fault selects, in its window or not, lost by another fault or
not. So a change of one fault never shifts the draws of another.
"""

from collections.abc import Sequence
from typing import Final

from drivers.timebase import Duration, Instant
from virtual_bus.bus.judge import LOST as LOST
from virtual_bus.faults.fates import DROPPED as DROPPED
from virtual_bus.faults.fates import PASSED as PASSED
from virtual_bus.faults.fates import FateSource as FateSource
from virtual_bus.faults.fates import FrameFate as FrameFate
from virtual_bus.faults.fault_log import EXTENDED_FLAG, KIND_CODES, FaultLog
from virtual_bus.faults.fault_plan import (
    STANDARD_ID_MAX,
    Blackout,
    Corruption,
    Delay,
    Direction,
    Duplication,
    Effect,
    FaultPlan,
    IndependentLoss,
    Loss,
    MeasuredDelay,
    PeriodicLoss,
    Reordering,
    node_of,
)
from virtual_bus.faults.fault_streams import UniformStream
from virtual_bus.faults.special_faults import (
    Instead,
    MeasuredHold,
    Special,
    SpecialFault,
    instead_of,
    replaced,
)
from virtual_bus.faults.strikes import FOREVER as FOREVER
from virtual_bus.faults.strikes import (
    BlackoutStrike,
    BurstStrike,
    Hold,
    IndependentStrike,
    PeriodicStrike,
    Strike,
    UniformHold,
    window,
)
from virtual_bus.frame import Frame

_DELAY: Final = KIND_CODES["delay"]


class _Queue:
    """The order of one link: no frame leaves before the one in front of it."""

    __slots__ = ("released_at",)

    def __init__(self) -> None:
        self.released_at = 0


class _Route:
    """All that can befall the frames of one COB-ID in one direction."""

    __slots__ = ("delays", "losses", "queue", "seen")

    def __init__(self, losses: list[Strike], delays: list[Hold], queue: _Queue | None) -> None:
        """``queue``: None where frames may overtake one another, or are never held."""
        self.losses = losses
        self.delays = delays
        self.queue = queue
        self.seen = 0


class _Way:
    """One direction: its routes, and what befell its frames."""

    __slots__ = ("delayed", "extended", "frames", "lost", "queues", "routes")

    def __init__(self, plan: FaultPlan) -> None:
        self.frames = 0
        self.delayed = 0
        self.lost = {fault.kind: 0 for fault in plan.faults if not isinstance(fault, Delay)}
        self.routes: dict[int, _Route] = {}
        self.queues: dict[int, _Queue] = {}
        self.extended: dict[int, int] = {}
        """How many of each extended identifier came; several share a route."""


class FaultInjector(FateSource):
    """Applies ``plan`` with the random streams of ``seed``; ``link`` tells the buses of a bench and the
    connections to them apart; ``node``: see :class:`FateSource`.

    ``error_frames``: the bus itself can disturb a frame on the wire, so the corruptions with that effect are
    left to it (:mod:`virtual_bus.faults.disturber`); without, such a frame is lost.
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
        super().__init__(log, node)
        self._instead: Instead = ()
        self._error_frames = error_frames
        self._plan = plan
        self._seed = seed
        self._link = link
        self._explicit = {
            item for fault in plan.faults for item in fault.selection.frames if isinstance(item, int)
        }
        self._forget()
        self._acts = False
        self._zero = Instant(0)

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``; every stream and every count begins anew."""
        self._forget()
        self._acts = True
        self._zero = now

    def stop(self) -> None:
        """From here on every frame passes. What is already held is not let go earlier."""
        self._acts = False

    def hold(self, way: int, can_id: int, now: Instant, extended: bool) -> int:
        """See :meth:`FateSource.hold`; every frame passes before ``start``."""
        if not self._acts:
            return 0
        here = self._ways[way]
        here.frames += 1
        route = here.routes.get(self._extended_key(can_id) if extended else can_id)
        if route is None:
            route = self._plan_route(Direction(way), can_id, extended)
        n = route.seen
        route.seen = n + 1
        if extended:
            n = here.extended.get(can_id, 0)
            here.extended[can_id] = n + 1
        elapsed = now - self._zero
        struck: Strike | None = None
        for loss in route.losses:
            if loss.strikes(elapsed) and struck is None:
                struck = loss
        held = 0
        for delay in route.delays:
            held += delay.holds(elapsed)
        if struck is None:
            held = self._in_order(route.queue, now, held)
            if held == 0:
                return 0
            here.delayed += 1
        else:
            held = self._strike(here, route.queue, struck, now, held)
        if self.log is not None:
            self.note(self.log, way, can_id | EXTENDED_FLAG if extended else can_id, n, elapsed, held)
        return held

    def _in_order(self, queue: _Queue | None, now: Instant, held: int) -> int:
        """``held``, or longer if the frame in front is."""
        if queue is not None:
            release = now + held
            if release < queue.released_at:
                self.waited = queue.released_at - release
                release = queue.released_at
                held = release - now
            queue.released_at = release
        return held

    def replacements(self, frame: Frame) -> Sequence[tuple[Frame, Duration]]:
        """See :class:`FateSource`."""
        return replaced(frame, self._instead) if self._instead else ()

    def keeps_order(self, way: int, can_id: int, extended: bool) -> bool:
        """See :class:`FateSource`."""
        route = self._ways[way].routes.get(self._extended_key(can_id) if extended else can_id)
        return route is not None and route.queue is not None

    def counts(self) -> dict[str, dict[str, int]]:
        """By direction: ``frames`` seen, those struck, by kind of the first fault to strike, ``delayed``."""
        return {
            direction.label: {"frames": way.frames, **way.lost, "delayed": way.delayed}
            for direction, way in zip(Direction, self._ways, strict=True)
        }

    def _strike(self, way: _Way, queue: _Queue | None, strike: Strike, now: Instant, held: int) -> int:
        """A fault other than a delay has struck: few frames come here."""
        self._instead = ()
        if not isinstance(strike, Special):
            way.lost[strike.label] += 1
            self.struck_by = strike.label
            return LOST
        way.lost[strike.kind] += 1
        self.struck_by = strike.kind
        if not strike.keeps:
            return LOST
        self.parameter = parameter = strike.parameter()
        release = now + held
        if queue is not None and release < queue.released_at:
            self.waited = queue.released_at - release
            release = queue.released_at
        if isinstance(strike.fault, Reordering):
            return release - now + parameter
        if queue is not None:
            queue.released_at = release
        self._instead = instead_of(strike.kind, parameter, Duration(release - now))
        return LOST

    def _forget(self) -> None:
        self.struck_by = ""
        self.waited = 0
        self._specials: dict[str, Special] = {}
        self._ways = [_Way(self._plan) for _ in Direction]
        self._chances: dict[tuple[int, Direction, int], Strike] = {}
        self._holds: dict[tuple[int, Direction, int], Hold] = {}

    def _extended_key(self, can_id: int) -> int:
        """Extended frames that no plan names share one route: 2^29 of them must not fill the memory."""
        return can_id if can_id > STANDARD_ID_MAX and can_id in self._explicit else -1

    def _plan_route(self, direction: Direction, can_id: int, extended: bool) -> _Route:
        node = node_of(can_id, extended)
        losses: list[Strike] = []
        delays: list[Hold] = []
        in_order = True
        for index, fault in enumerate(self._plan.faults):
            if not fault.selection.selects(direction, can_id, extended):
                continue
            if isinstance(fault, Delay):
                delays.append(self._delay(index, fault, direction, node))
                in_order = in_order and not fault.reorder
            elif not isinstance(fault, SpecialFault):
                losses.append(self._loss(index, fault, direction, node))
        losses += self._special_strikes(direction, can_id, extended)
        way = self._ways[direction]
        queue = way.queues.setdefault(node, _Queue()) if delays and in_order else None
        route = way.routes[self._extended_key(can_id) if extended else can_id] = _Route(losses, delays, queue)
        return route

    def _special_strikes(self, direction: Direction, can_id: int, extended: bool) -> list[Strike]:
        """After the losses: a frame that is lost is lost, whatever else struck it."""
        node = node_of(can_id, extended)
        found: list[Strike] = []
        for kind in (Corruption, Duplication, Reordering):
            for index, fault in enumerate(self._plan.faults):
                if not isinstance(fault, kind) or not fault.selection.selects(direction, can_id, extended):
                    continue
                if (
                    isinstance(fault, Corruption)
                    and self._error_frames
                    and fault.effect is Effect.ERROR_FRAME
                ):
                    continue
                label = f"{direction.label}/{node}/{index}"
                special = self._specials.get(label)
                if special is None:
                    draw = self._stream(index, direction, node).draw
                    special = Special(label, fault, *window(fault.selection), draw)
                    self._specials[label] = special
                found.append(special)
        return found

    def _loss(self, index: int, fault: Loss, direction: Direction, node: int) -> Strike:
        """Chance is the link's; counting is each COB-ID's, so that all PDOs of a cycle fare alike."""
        if isinstance(fault, PeriodicLoss):
            return PeriodicStrike(fault)
        if isinstance(fault, Blackout):
            return BlackoutStrike(fault)
        key = (index, direction, node)
        if key not in self._chances:
            stream = self._stream(*key)
            if isinstance(fault, IndependentLoss):
                self._chances[key] = IndependentStrike(fault, stream)
            else:
                self._chances[key] = BurstStrike(fault, stream)
        return self._chances[key]

    def _delay(self, index: int, fault: Delay, direction: Direction, node: int) -> Hold:
        key = (index, direction, node)
        if key not in self._holds:
            stream = self._stream(*key)
            if isinstance(fault, MeasuredDelay):
                self._holds[key] = MeasuredHold(fault, *window(fault.selection), stream.draw)
            else:
                self._holds[key] = UniformHold(fault, stream)
        return self._holds[key]

    def _stream(self, index: int, direction: Direction, node: int) -> UniformStream:
        """Named by the fault's place among its own kind: faults of other kinds do not count."""
        kind = self._plan.faults[index].kind
        place = sum(fault.kind == kind for fault in self._plan.faults[:index])
        return UniformStream(self._seed, f"{self._link}/{direction.label}/{node}/{kind}/{place}")
