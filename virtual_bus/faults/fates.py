"""The fates of frames: the one place where frames are struck, kept in order, counted and logged.

The decision is made by a route, one for each COB-ID in each direction: drawn from a plan
(:mod:`.fault_injector`), or out of a recorded run (:mod:`.replay`).

Faults of a recorded run, injected again: each frame and each node meets what it met then.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from servobench.drivers.bounded_file import NamedBy, read_lines
from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import EXTENDED_FLAG
from servobench.virtual_bus.bus.judge import LOST, Direction, Judge
from servobench.virtual_bus.core.native import Fates
from servobench.virtual_bus.core.native import Queue as Queue
from servobench.virtual_bus.core.native import Route as Route
from servobench.virtual_bus.faults.fault_log import (
    AT_NODE,
    FRAME_KINDS,
    HOST_KINDS,
    KIND_CODES,
    NODE_KINDS,
    FaultEntry,
    FaultLog,
    read_line,
)
from servobench.virtual_bus.faults.fault_table import NONE, UNDAMAGED
from servobench.virtual_bus.faults.frame_fault import node_of
from servobench.virtual_bus.faults.kinds.corruption import ERROR_FRAME
from servobench.virtual_bus.faults.register import LOG_KINDS
from servobench.virtual_bus.frame import Frame


class FateSource(Fates, Judge):
    """A judge of frames that counts and logs what it does; which fault strikes is core/fates.c."""

    def __init__(
        self, kinds: Sequence[str], explicit: frozenset[int], log: FaultLog | None, node: int
    ) -> None:
        """``kinds``: that strike. ``explicit``: the extended identifiers, with EXTENDED_FLAG, that have
        a route of their own.
        ``log``: takes an entry for every frame that does not just pass. ``node``: the drive at whose
        connection the frames are; 0 at the host's."""
        self._place = node * AT_NODE
        super().__init__(log, self._place, KIND_CODES["delay"])
        self._kinds = list(dict.fromkeys(kinds))
        self._explicit = explicit
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._instead: list[tuple[int, Duration]] = []
        self._struck = [dict.fromkeys(self._kinds, 0) for _ in Direction]
        self._queues: tuple[dict[int, Queue], ...] = tuple({} for _ in Direction)
        self._extended: dict[tuple[int, int], Route] = {}
        self._extended_seen: dict[tuple[int, int], int] = {}
        """How many of each extended identifier came; several share a route."""

    def route(self, way: int, can_id: int, extended: bool) -> Route:
        """For frames that are the first of their COB-ID. Override."""
        raise NotImplementedError

    def extended_route(self, way: int, can_id: int, extended: bool) -> tuple[Route, int]:
        """The route of an extended frame, and the how-manieth of its identifier this one is."""
        key = can_id | EXTENDED_FLAG
        # Those that nobody names share one route: 2^29 of them must not fill the memory.
        place = way, key if key in self._explicit else -1
        if place not in self._extended:
            self._extended[place] = self.route(way, can_id, extended)
        n = self._extended_seen.get((way, can_id), 0)
        self._extended_seen[way, can_id] = n + 1
        return self._extended[place], n

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``; every count begins anew."""
        super().start(now)
        self._begin_anew()

    def strike(
        self, route: Route, way: int, can_id: int, extended: bool, n: int, now: Instant, held: int
    ) -> int:
        """A fault other than a delay has struck: few frames come here. Returns what :meth:`hold` does."""
        assert route.struck is not None
        self._struck[way][route.struck] += 1
        code = KIND_CODES[route.struck]
        kind, number, queue = LOG_KINDS[code], route.number, route.queue
        copies = () if kind.copies is None or number == NONE else kind.copies(number)
        if self.log is not None:
            key = can_id | EXTENDED_FLAG if extended else can_id
            self.log.note(code, now - self.zero, self._place + way, key, n, number, held if copies else 0)
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
        return self._queues[way].setdefault(node_of(can_id, extended), Queue())

    def replacements(self, frame: Frame) -> Sequence[tuple[Frame, Duration]]:
        """See :class:`Judge`."""
        return [(damaged(frame, bit), delay) for bit, delay in self._instead]

    def counts(self) -> dict[str, dict[str, int]]:
        """By direction: ``frames`` seen, those struck, by kind of the fault that struck, ``delayed``."""
        counted = {}
        for direction in Direction:
            frames, delayed = self.tally(direction)
            counted[direction.label] = {"frames": frames, **self._struck[direction], "delayed": delayed}
        return counted


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


SIZE_MAX_BYTES = 4_000_000_000
"""Three hours at 1 kHz in which every frame is delayed."""


@dataclass(frozen=True, slots=True)
class RecordedFaults:
    """The entries of a run, in order."""

    entries: tuple[FaultEntry, ...] = ()

    @property
    def span(self) -> Duration:
        """When the last one struck, ns after time zero."""
        return Duration(max((entry.at_ns for entry in self.entries), default=0))

    @property
    def node_kinds(self) -> tuple[str, ...]:
        """Which kinds befall nodes themselves, the host among them."""
        kinds = {entry.kind for entry in self.entries}
        return tuple(kind for kind in (*NODE_KINDS, *HOST_KINDS) if kind in kinds)

    @property
    def drives_struck(self) -> frozenset[int]:
        """The drives at whose own connection frames were struck."""
        return frozenset(entry.at_drive for entry in self.entries if entry.kind in FRAME_KINDS) - {0}


def read_recorded(path: Path, named_by: NamedBy | None = None) -> RecordedFaults:
    """The faults that a run has recorded in ``path``; ``named_by``: who names it. Raises BadInput."""
    lines = read_lines(path, "file of recorded faults", named_by, SIZE_MAX_BYTES)
    entries = [read_line(text, str(path), n) for n, text in enumerate(lines, start=1) if text.strip()]
    return RecordedFaults(tuple(entries))


class _ReplayedRoute(Route):
    """By what befell the frames of one COB-ID."""

    _entries: Mapping[int, FaultEntry]

    def __new__(cls, entries: Mapping[int, FaultEntry], queue: Queue | None) -> Self:
        route = super().__new__(cls, queue, (), ())
        route._entries = entries
        return route

    def meet(self, elapsed: int, n: int) -> int:  # noqa: ARG002
        entry = self._entries.get(n)
        self.struck = None
        if entry is None:
            return 0
        if entry.kind == "delay":
            return entry.a
        self.struck, self.number = entry.kind, entry.a
        return entry.b


class ReplayedFates(FateSource):
    """Fates out of recorded entries.

    A frame is known by its place among those of its identifier and direction. In a run that differs
    from the recorded one, frames that were held in order keep their order all the same.
    """

    def __init__(self, recorded: RecordedFaults, log: FaultLog | None = None, node: int = 0) -> None:
        self._entries: dict[tuple[int, int], dict[int, FaultEntry]] = defaultdict(dict)
        kinds: dict[str, None] = {}
        for entry in recorded.entries:
            kind = entry.kind
            strikes = kind in FRAME_KINDS and kind != ERROR_FRAME and not LOG_KINDS[entry.code].alters
            if strikes and entry.at_drive == node:
                self._entries[int(entry.direction), entry.can_id][entry.n] = entry
                kinds[kind] = None
        kinds.pop("delay", None)
        explicit = frozenset(key for _, key in self._entries if key & EXTENDED_FLAG)
        super().__init__(list(kinds), explicit, log, node)

    def route(self, way: int, can_id: int, extended: bool) -> Route:
        """See :class:`FateSource`."""
        entries = self._entries.get((way, can_id | EXTENDED_FLAG if extended else can_id), {})
        in_order = any(entry.kind == "delay" and entry.b for entry in entries.values())
        return _ReplayedRoute(entries, self.queue(way, can_id, extended) if in_order else None)
