"""What becomes of a frame: the one place where frames are struck, kept in order, counted and logged.

Who decides is a route, one for each COB-ID in each direction: drawn from a plan (:mod:`.fault_injector`), or
out of a recorded run (:mod:`.replay`).
"""

from collections.abc import Sequence
from typing import Final

from mypy_extensions import mypyc_attr

from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.identifiers import EXTENDED_FLAG
from servobench.virtual_bus.bus.judge import LOST, Direction, Judge
from servobench.virtual_bus.faults.fault_log import AT_NODE, KIND_CODES, FaultLog
from servobench.virtual_bus.faults.frame_fault import node_of
from servobench.virtual_bus.faults.log_kind import NONE, UNDAMAGED
from servobench.virtual_bus.faults.register import LOG_KINDS
from servobench.virtual_bus.frame import Frame

_DELAY: Final = KIND_CODES["delay"]


class Queue:
    """The order of one link: no frame leaves before the one in front of it."""

    __slots__ = ("released_at",)

    def __init__(self) -> None:
        self.released_at = 0

    def behind(self, release: int) -> int:
        """``release``, or later if the one in front is held for longer; the next one waits for it."""
        if release > self.released_at:
            self.released_at = release
        return self.released_at


@mypyc_attr(allow_interpreted_subclasses=True)
class Route:
    """All that can befall the frames of one COB-ID in one direction."""

    def __init__(self, queue: Queue | None) -> None:
        """``queue``: None where frames may overtake one another, or are never held."""
        self.queue = queue
        self.seen = 0
        self.struck = ""
        """The kind of fault that struck the last frame, as its log entry has it; empty: none."""
        self.number = 0
        """The first number of that entry."""

    def meet(self, elapsed: int, n: int) -> int:
        """For how many ns the ``n``-th frame is held, and what strikes it; asked once for each."""
        raise NotImplementedError


class _Way:
    """One direction: its routes, and what befell its frames."""

    __slots__ = ("delayed", "extended", "frames", "queues", "routes", "struck")

    def __init__(self, kinds: Sequence[str]) -> None:
        self.frames = 0
        self.delayed = 0
        self.struck = dict.fromkeys(kinds, 0)
        self.routes: dict[int, Route] = {}
        self.queues: dict[int, Queue] = {}
        self.extended: dict[int, int] = {}
        """How many of each extended identifier came; several share a route."""


@mypyc_attr(allow_interpreted_subclasses=True)
class FateSource(Judge):
    """A judge of frames that counts and logs what it does."""

    def __init__(
        self, kinds: Sequence[str], explicit: frozenset[int], log: FaultLog | None, node: int
    ) -> None:
        """``kinds``: that strike. ``explicit``: the extended identifiers, with EXTENDED_FLAG, that have
        a route of their own.
        ``log``: takes an entry for every frame that does not just pass. ``node``: the drive at whose
        connection the frames are; 0 at the host's."""
        self.log = log
        self._place = node * AT_NODE
        self._kinds = list(dict.fromkeys(kinds))
        self._explicit = explicit
        self._instead: list[tuple[int, Duration]] = []
        self._acts = False
        self._zero = Instant(0)
        self._ways = [_Way(self._kinds) for _ in Direction]

    def route(self, way: int, can_id: int, extended: bool) -> Route:
        """For frames that are the first of their COB-ID. Override."""
        raise NotImplementedError

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``; every count begins anew."""
        self._ways = [_Way(self._kinds) for _ in Direction]
        self._instead = []
        self._acts = True
        self._zero = now

    def stop(self) -> None:
        """From here on every frame passes. What is already held is not let go earlier."""
        self._acts = False

    def hold(self, way: int, can_id: int, now: Instant, extended: bool) -> int:
        """See :class:`Judge`; every frame passes before ``start``."""
        if not self._acts:
            return 0
        here = self._ways[way]
        here.frames += 1
        key = place = can_id
        if extended:
            key = can_id | EXTENDED_FLAG
            # Those that nobody names share one route: 2^29 of them must not fill the memory.
            place = key if key in self._explicit else -1
        route = here.routes.get(place)
        if route is None:
            route = here.routes[place] = self.route(way, can_id, extended)
        n = route.seen
        route.seen = n + 1
        if extended:
            n = here.extended.get(can_id, 0)
            here.extended[can_id] = n + 1
        elapsed = now - self._zero
        held = route.meet(elapsed, n)
        if route.struck:
            return self._strike(here, route, way, key, n, now, held)
        queue, drawn = route.queue, held
        if queue is not None:
            held = queue.behind(now + held) - now
        if held == 0:
            return 0
        here.delayed += 1
        log = self.log
        if log is not None:
            log.note(_DELAY, elapsed, self._place + way, key, n, drawn, queue is not None)
        return held

    def _strike(self, here: _Way, route: Route, way: int, key: int, n: int, now: Instant, held: int) -> int:
        """A fault other than a delay has struck: few frames come here."""
        here.struck[route.struck] += 1
        code = KIND_CODES[route.struck]
        kind, number, queue = LOG_KINDS[code], route.number, route.queue
        copies = () if kind.copies is None or number == NONE else kind.copies(number)
        if self.log is not None:
            self.log.note(code, now - self._zero, self._place + way, key, n, number, held if copies else 0)
        self._instead = []
        if not copies:
            return LOST
        if queue is not None:
            held = max(held, queue.released_at - now)
            if kind.in_order:
                queue.released_at = now + held
        bit, later = copies[0]
        if len(copies) == 1 and bit == UNDAMAGED:
            return held + later
        self._instead = [(bit, Duration(held + later)) for bit, later in copies]
        return LOST

    def queue(self, way: int, can_id: int, extended: bool) -> Queue:
        """The order of that frame's link."""
        return self._ways[way].queues.setdefault(node_of(can_id, extended), Queue())

    def replacements(self, frame: Frame) -> Sequence[tuple[Frame, Duration]]:
        """See :class:`Judge`."""
        return [(damaged(frame, bit), delay) for bit, delay in self._instead]

    def counts(self) -> dict[str, dict[str, int]]:
        """By direction: ``frames`` seen, those struck, by kind of the fault that struck, ``delayed``."""
        return {
            direction.label: {"frames": way.frames, **way.struck, "delayed": way.delayed}
            for direction, way in zip(Direction, self._ways, strict=True)
        }


def damaged(frame: Frame, bit: int) -> Frame:
    """``frame`` with one bit of its data inverted; as it is if it has no data or ``bit`` is UNDAMAGED."""
    data = frame.data
    if bit == UNDAMAGED or not data:
        return frame
    place = bit % (8 * len(data))
    changed = bytearray(data)
    changed[place // 8] ^= 1 << place % 8
    struck = Frame(frame.can_id, bytes(changed), frame.extended, frame.remote, frame.remote_length)
    struck.handed_at = frame.handed_at
    return struck
