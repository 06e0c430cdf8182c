"""Which lines of a trace somebody wants to see."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from drivers.timebase import NS_PER_S
from hil.reviewing.trace.trace_entry import TraceEntry


class TraceSelection(NamedTuple):
    """Everything, unless told otherwise."""

    node: int | None = None
    """Its lines, and NMT commands to all nodes."""
    kinds: frozenset[str] = frozenset()
    """Empty: all."""
    from_s: float | None = None
    to_s: float | None = None

    def of(self, entries: Iterable[TraceEntry], zero_ns: int) -> Iterator[TraceEntry]:
        """Those that are wanted; ``zero_ns``: what the times count from."""
        for entry in entries:
            if self.kinds and entry.kind not in self.kinds:
                continue
            for_all = entry.kind == "nmt" and entry.node is None
            if self.node is not None and entry.node != self.node and not for_all:
                continue
            if self._in_time(entry, zero_ns):
                yield entry

    def _in_time(self, entry: TraceEntry, zero_ns: int) -> bool:
        if self.from_s is None and self.to_s is None:
            return True
        if entry.at_ns is None:
            return False
        at_s = (entry.at_ns - zero_ns) / NS_PER_S
        return (self.from_s is None or at_s >= self.from_s) and (self.to_s is None or at_s <= self.to_s)
