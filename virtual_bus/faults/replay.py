"""Faults of a recorded run, injected again: each frame and each node meets what it met then."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from servobench.drivers.bounded_file import NamedBy, read_lines
from servobench.drivers.timebase import Duration
from servobench.drivers.wire.identifiers import EXTENDED_FLAG
from servobench.virtual_bus.faults.fates import FateSource, Queue, Route
from servobench.virtual_bus.faults.fault_log import (
    FRAME_KINDS,
    HOST_KINDS,
    NODE_KINDS,
    FaultEntry,
    FaultLog,
    read_line,
)
from servobench.virtual_bus.faults.kinds.corruption import ERROR_FRAME
from servobench.virtual_bus.faults.register import LOG_KINDS

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
