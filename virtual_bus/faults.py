"""The fate of every frame under a fault plan: pure, seeded, the same on every machine.

A link is one direction of the traffic of one node; frames of no single node (SYNC, NMT, TIME)
form a link of their own. Each fault has its own random stream on each link, and each stream
moves on by every frame that the fault selects, in its window or not, lost by another fault or
not. So a change of one fault never shifts the draws of another.
"""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol

from drivers.timebase import Duration, Instant
from virtual_bus.fault_injection.fault_plan import (
    STANDARD_ID_MAX,
    Blackout,
    BurstLoss,
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
    Selection,
    UniformDelay,
    node_of,
)
from virtual_bus.fault_injection.fault_streams import uniform_stream
from virtual_bus.fault_injection.special_faults import (
    Instead,
    Special,
    SpecialFault,
    instead_of,
    measured_hold,
    replaced,
)
from virtual_bus.frame import Frame

FOREVER: Final = Instant(2**63 - 1)


class Fate(NamedTuple):
    """What becomes of a frame."""

    dropped: bool
    """It does not go on as it is; ``replacements`` says what does, if anything."""
    delay_ns: Duration
    """From the instant given to ``fate`` until it goes on; 0 if dropped."""


PASSED: Final = Fate(False, Duration(0))
DROPPED: Final = Fate(True, Duration(0))
_new_fate: Final = tuple.__new__
_FATE: Final = Fate
"""A third of the time of ``Fate(...)``, for the path of every frame."""


class FateSource(Protocol):
    """Decides about frames: a seeded injector, or the replay of a recorded run."""

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``."""
        ...

    def stop(self) -> None:
        """From here on every frame passes."""
        ...

    def fate(self, direction: Direction, can_id: int, now: Instant, extended: bool = False) -> Fate:
        """What becomes of a frame that is there at ``now``; ``now`` may not run backwards in a direction."""
        ...

    def replacements(self, frame: Frame) -> Sequence[tuple[Frame, Duration]]:
        """What goes on in place of ``frame``, which the last fate dropped: copies or damaged ones, each with
        its delay; empty if it is lost."""
        ...

    def counts(self) -> dict[str, dict[str, int]]:
        """Frames by direction and by what befell them."""
        ...


Strikes = Callable[[int], bool]
"""Whether a loss takes the frame that is there so many ns after time zero."""
Holds = Callable[[int], int]
"""For how many ns a delay holds it."""
Draw = Callable[[], float]


def _window(selection: Selection) -> tuple[int, int]:
    """First ns in which a fault acts, and the first in which it does so no more."""
    return selection.from_ns, FOREVER if selection.until_ns is None else selection.until_ns


def _independent_loss(fault: IndependentLoss, draw: Draw) -> Strikes:
    probability = fault.probability
    begin, end = _window(fault.selection)

    def strikes(elapsed: int) -> bool:
        return draw() < probability and begin <= elapsed < end

    return strikes


def _burst_loss(fault: BurstLoss, draw: Draw) -> Strikes:
    """Two draws for every frame, so that the chain's path never depends on the loss probabilities."""
    begin, end = _window(fault.selection)
    bad = False

    def strikes(elapsed: int) -> bool:
        nonlocal bad
        move, lose = draw(), draw()
        bad = move >= fault.p_bad_to_good if bad else move < fault.p_good_to_bad
        return lose < (fault.loss_bad if bad else fault.loss_good) and begin <= elapsed < end

    return strikes


def _periodic_loss(fault: PeriodicLoss) -> Strikes:
    begin, end = _window(fault.selection)
    period = fault.lost + 1
    count = -1

    def strikes(elapsed: int) -> bool:
        nonlocal count
        if not begin <= elapsed < end:
            return False
        count += 1
        return count % period != 0

    return strikes


def _blackout(fault: Blackout) -> Strikes:
    begin, end = _window(fault.selection)
    left: int = FOREVER if fault.count is None else fault.count

    def strikes(elapsed: int) -> bool:
        nonlocal left
        if left == 0 or not begin <= elapsed < end:
            return False
        left -= 1
        return True

    return strikes


def _uniform_delay(fault: UniformDelay, draw: Draw) -> Holds:
    begin, end = _window(fault.selection)
    least, width = fault.min_ns, fault.max_ns - fault.min_ns + 1

    def holds(elapsed: int) -> int:
        held = least + int(draw() * width)
        return held if begin <= elapsed < end else 0

    return holds


class _Queue:
    """The order of one link: no frame leaves before the one in front of it."""

    __slots__ = ("released_at",)

    def __init__(self) -> None:
        self.released_at = 0


class _Route(NamedTuple):
    """All that can befall the frames of one COB-ID in one direction."""

    losses: tuple[tuple[str, Strikes], ...]
    delays: tuple[Holds, ...]
    queue: _Queue | None
    """None where frames may overtake one another, or are never held."""


class _Way:
    """One direction: its routes, and what befell its frames."""

    __slots__ = ("delayed", "frames", "lost", "queues", "routes")

    def __init__(self, plan: FaultPlan) -> None:
        self.frames = 0
        self.delayed = 0
        self.lost = {fault.kind: 0 for fault in plan.faults if not isinstance(fault, Delay)}
        self.routes: dict[int, _Route] = {}
        self.queues: dict[int, _Queue] = {}


class FaultInjector:
    """Applies ``plan`` with the random streams of ``seed``; ``link`` tells several buses of a bench apart.

    ``error_frames``: the bus itself can disturb a frame on the wire, so the corruptions with that effect are
    left to it (:mod:`virtual_bus.fault_injection.disturber`); without, such a frame is lost.
    """

    def __init__(self, plan: FaultPlan, seed: int, link: str = "bus", error_frames: bool = False) -> None:
        self.struck_by = ""
        """The kind of fault that struck the last frame that was dropped or held out of order."""
        self.parameter = 0
        """What that fault drew, see :meth:`Special.parameter`."""
        self.waited = 0
        """How long the last frame that had to wait for one in front of it did so, ns."""
        self._instead: Instead = ()
        self._error_frames = error_frames
        self._plan = plan
        self._seed = seed
        self._link = link
        self._explicit = {
            item for fault in plan.faults for item in fault.selection.frames if isinstance(item, int)
        }
        self._forget()
        self._zero: Instant | None = None

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``; every stream and every count begins anew."""
        self._forget()
        self._zero = now

    def stop(self) -> None:
        """From here on every frame passes. What is already held is not let go earlier."""
        self._zero = None

    def fate(self, direction: Direction, can_id: int, now: Instant, extended: bool = False) -> Fate:
        """What becomes of a frame that is there at ``now``; every frame passes before ``start``."""
        zero = self._zero
        if zero is None:
            return PASSED
        way = self._ways[direction]
        way.frames += 1
        key = self._extended_key(can_id) if extended else can_id
        route = way.routes.get(key)
        if route is None:
            route = way.routes[key] = self._plan_route(direction, can_id, extended)
        losses, delays, queue = route
        elapsed = now - zero
        lost_to = None
        for kind, strikes in losses:
            if strikes(elapsed) and lost_to is None:
                lost_to = kind
        held = 0
        for holds in delays:
            held += holds(elapsed)
        if lost_to is not None:
            return self._strike(way, queue, lost_to, now, held)
        if queue is not None:
            release = now + held
            if release < queue.released_at:
                self.waited = queue.released_at - release
                release = queue.released_at
                held = release - now
            queue.released_at = release
        if held == 0:
            return PASSED
        way.delayed += 1
        return _new_fate(_FATE, (False, held))

    def replacements(self, frame: Frame) -> Sequence[tuple[Frame, Duration]]:
        """See :class:`FateSource`."""
        return replaced(frame, self._instead) if self._instead else ()

    def keeps_order(self, direction: Direction, can_id: int, extended: bool) -> bool:
        """Whether a held frame of that kind waits for the one in front of it."""
        key = self._extended_key(can_id) if extended else can_id
        route = self._ways[direction].routes.get(key)
        return route is not None and route.queue is not None

    def counts(self) -> dict[str, dict[str, int]]:
        """By direction: ``frames`` seen, those struck, by kind of the first fault to strike, ``delayed``."""
        return {
            direction.label: {"frames": way.frames, **way.lost, "delayed": way.delayed}
            for direction, way in zip(Direction, self._ways, strict=True)
        }

    def _strike(self, way: _Way, queue: _Queue | None, label: str, now: Instant, held: int) -> Fate:
        """A fault other than a delay has struck: few frames come here."""
        self._instead = ()
        special = self._specials.get(label)
        if special is None:
            way.lost[label] += 1
            self.struck_by = label
            return DROPPED
        way.lost[special.kind] += 1
        self.struck_by = special.kind
        if not special.keeps:
            return DROPPED
        self.parameter = parameter = special.parameter()
        release = now + held
        if queue is not None and release < queue.released_at:
            self.waited = queue.released_at - release
            release = queue.released_at
        if isinstance(special.fault, Reordering):
            return Fate(False, Duration(release - now + parameter))
        if queue is not None:
            queue.released_at = release
        self._instead = instead_of(special.kind, parameter, Duration(release - now))
        return DROPPED

    def _forget(self) -> None:
        self._specials: dict[str, Special] = {}
        self._ways = tuple(_Way(self._plan) for _ in Direction)
        self._chances: dict[tuple[int, Direction, int], Strikes] = {}
        self._holds: dict[tuple[int, Direction, int], Holds] = {}

    def _extended_key(self, can_id: int) -> int:
        """Extended frames that no plan names share one route: 2^29 of them must not fill the memory."""
        return can_id if can_id > STANDARD_ID_MAX and can_id in self._explicit else -1

    def _plan_route(self, direction: Direction, can_id: int, extended: bool) -> _Route:
        node = node_of(can_id, extended)
        losses: list[tuple[str, Strikes]] = []
        delays: list[Holds] = []
        in_order = True
        for index, fault in enumerate(self._plan.faults):
            if not fault.selection.selects(direction, can_id, extended):
                continue
            if isinstance(fault, Delay):
                delays.append(self._delay(index, fault, direction, node))
                in_order = in_order and not fault.reorder
            elif not isinstance(fault, SpecialFault):
                losses.append((fault.kind, self._loss(index, fault, direction, node)))
        losses += self._special_strikes(direction, can_id, extended)
        queues = self._ways[direction].queues
        queue = queues.setdefault(node, _Queue()) if delays and in_order else None
        return _Route(tuple(losses), tuple(delays), queue)

    def _special_strikes(
        self, direction: Direction, can_id: int, extended: bool
    ) -> list[tuple[str, Strikes]]:
        """After the losses: a frame that is lost is lost, whatever else struck it."""
        node = node_of(can_id, extended)
        found: list[tuple[str, Strikes]] = []
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
                    draw = self._stream(index, direction, node)
                    special = self._specials[label] = Special(fault, *_window(fault.selection), draw)
                found.append((label, special.strikes))
        return found

    def _loss(self, index: int, fault: Loss, direction: Direction, node: int) -> Strikes:
        """Chance is the link's; counting is each COB-ID's, so that all PDOs of a cycle fare alike."""
        if isinstance(fault, PeriodicLoss):
            return _periodic_loss(fault)
        if isinstance(fault, Blackout):
            return _blackout(fault)
        key = (index, direction, node)
        if key not in self._chances:
            draw = self._stream(*key)
            if isinstance(fault, IndependentLoss):
                self._chances[key] = _independent_loss(fault, draw)
            else:
                self._chances[key] = _burst_loss(fault, draw)
        return self._chances[key]

    def _delay(self, index: int, fault: Delay, direction: Direction, node: int) -> Holds:
        key = (index, direction, node)
        if key not in self._holds:
            draw = self._stream(*key)
            if isinstance(fault, MeasuredDelay):
                self._holds[key] = measured_hold(fault, *_window(fault.selection), draw)
            else:
                self._holds[key] = _uniform_delay(fault, draw)
        return self._holds[key]

    def _stream(self, index: int, direction: Direction, node: int) -> Draw:
        """Named by the fault's place among its own kind: faults of other kinds do not count."""
        kind = self._plan.faults[index].kind
        place = sum(fault.kind == kind for fault in self._plan.faults[:index])
        return uniform_stream(self._seed, f"{self._link}/{direction.label}/{node}/{kind}/{place}")
