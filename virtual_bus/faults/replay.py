"""Faults of a recorded run, injected again: each frame and each node meets what it met then."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.bounded_file import NamedBy, read_lines
from drivers.timebase import Duration, Instant
from virtual_bus.bus.judge import LOST
from virtual_bus.faults.fates import FateSource
from virtual_bus.faults.fault_log import (
    EXTENDED_FLAG,
    FRAME_KINDS,
    HOST_KINDS,
    NODE_KINDS,
    NONE,
    FaultEntry,
    FaultLog,
    read_line,
)
from virtual_bus.faults.fault_plan import Direction, node_of
from virtual_bus.faults.special_faults import Instead, instead_of, replaced
from virtual_bus.frame import Frame

SIZE_MAX_BYTES = 4_000_000_000
"""Three hours at 1 kHz in which every frame is delayed."""
_GOES_ON = frozenset({"corruption", "duplicate"})


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
        found = {entry.kind for entry in self.entries}
        return tuple(kind for kind in (*NODE_KINDS, *HOST_KINDS) if kind in found)

    @property
    def drives_struck(self) -> frozenset[int]:
        """The drives at whose own connection frames were struck."""
        return frozenset(entry.at_drive for entry in self.entries if entry.kind in FRAME_KINDS) - {0}


def read_recorded(path: Path, named_by: NamedBy | None = None) -> RecordedFaults:
    """The faults that a run has recorded in ``path``; ``named_by``: who names it. Raises BadInput."""
    lines = read_lines(path, "file of recorded faults", named_by, SIZE_MAX_BYTES)
    entries = [read_line(text, str(path), n) for n, text in enumerate(lines, start=1) if text.strip()]
    return RecordedFaults(tuple(entries))


class ReplayedFates(FateSource):
    """Fates out of recorded entries.

    A frame is known by its place among those of its identifier and direction. In a run that differs
    from the recorded one, frames that were held in order keep their order all the same.
    """

    def __init__(self, recorded: RecordedFaults, log: FaultLog | None = None, node: int = 0) -> None:
        super().__init__(log, node)
        self._entries: tuple[dict[tuple[int, int], FaultEntry], ...] = ({}, {})
        self._ordered: set[tuple[int, int]] = set()
        self._kinds: list[str] = []
        for entry in recorded.entries:
            kind = entry.kind
            if kind not in FRAME_KINDS or kind == "error_frame" or entry.at_drive != node:
                continue
            way = int(entry.direction)
            self._entries[way][entry.can_id, entry.n] = entry
            if kind == "delay" and entry.b:
                self._ordered.add((way, entry.can_id))
            if kind != "delay" and kind not in self._kinds:
                self._kinds.append(kind)
        self._zero: Instant | None = None
        self._instead: Instead = ()
        self._forget()

    def start(self, now: Instant) -> None:
        """Time zero of the recorded run is ``now``."""
        self._forget()
        self._zero = now

    def stop(self) -> None:
        """From here on every frame passes."""
        self._zero = None

    def hold(self, way: int, can_id: int, now: Instant, extended: bool) -> int:
        """See :class:`FateSource`."""
        if self._zero is None:
            return 0
        key = can_id | EXTENDED_FLAG if extended else can_id
        counts = self._frames[way]
        n = counts.get(key, 0)
        counts[key] = n + 1
        self._seen[way] += 1
        link = (way, node_of(can_id, extended)) if (way, key) in self._ordered else None
        held = self._apply(self._entries[way].get((key, n)), way, link, now)
        if held != 0 and self.log is not None:
            self.note(self.log, way, key, n, now - self._zero, held)
        return held

    def _apply(self, entry: FaultEntry | None, way: int, link: tuple[int, int] | None, now: Instant) -> int:
        self._instead = ()
        kind = "delay" if entry is None else entry.kind
        if entry is None or kind == "delay":
            held = self._release(link, now, 0 if entry is None else entry.a) - now
            self._delayed[way] += held != 0
            return held
        self._struck[way][kind] += 1
        self.struck_by, self.parameter = kind, entry.a
        if kind == "reorder":
            release = now + entry.b
            if link is not None:
                release = self._behind(link, release)
            return release - now + entry.a
        if kind in _GOES_ON and entry.a != NONE:
            self._instead = instead_of(kind, entry.a, Duration(self._release(link, now, entry.b) - now))
        return LOST

    def _release(self, link: tuple[int, int] | None, now: Instant, held: int) -> int:
        release = now + held
        if link is not None:
            release = self._released_at[link] = self._behind(link, release)
        return release

    def _behind(self, link: tuple[int, int], release: int) -> int:
        """``release``, or later if the one in front is held for longer."""
        front = self._released_at.get(link, 0)
        self.waited = max(0, front - release)
        return max(release, front)

    def replacements(self, frame: Frame) -> Sequence[tuple[Frame, Duration]]:
        """See :class:`FateSource`."""
        return replaced(frame, self._instead) if self._instead else ()

    def keeps_order(self, way: int, can_id: int, extended: bool) -> bool:
        """See :class:`FateSource`."""
        return (way, can_id | EXTENDED_FLAG if extended else can_id) in self._ordered

    def counts(self) -> dict[str, dict[str, int]]:
        """As :meth:`virtual_bus.faults.fault_injector.FaultInjector.counts`."""
        return {
            way.label: {"frames": self._seen[way], **self._struck[way], "delayed": self._delayed[way]}
            for way in Direction
        }

    def _forget(self) -> None:
        self._frames: tuple[dict[int, int], ...] = ({}, {})
        self._seen = [0, 0]
        self._delayed = [0, 0]
        self._struck = [dict.fromkeys(self._kinds, 0) for _ in Direction]
        self._released_at: dict[tuple[int, int], int] = {}
        self._instead = ()
