"""What was injected, as events: each thing that befell a node, and of the faults of frames and the stalls of
the host from when to when they struck."""

from collections.abc import Sequence
from typing import Final

from drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from hil.rows.side_rows import TextEvent
from virtual_bus.faults.fault_log import EXTENDED_FLAG, HOST_KINDS, FaultEntry
from virtual_bus.faults.node_fault import NodeEvent
from virtual_bus.faults.node_faults import node_kind
from virtual_bus.faults.register import LOG_KINDS

WINDOW_GAP: Final = Duration(NS_PER_S // 2)
"""Strikes of one fault that are no further apart belong to one window: a loss of 1 % of the readings of one
axis at 1 kHz has one each 100 ms, and a gap as long as this once in 15 s."""
_IN_WINDOWS: Final = frozenset(code for code, kind in enumerate(LOG_KINDS) if kind.in_windows)


class _Window:
    """Strikes of one fault in a row."""

    def __init__(self, what: str, at: Instant) -> None:
        self.what = what
        self.first = self.last = at
        self.count = 1


class InjectedFaults:
    """Tells of entries as they come."""

    def __init__(self) -> None:
        self._windows: dict[tuple[int, int], _Window] = {}
        """Those that are open, by kind and link."""

    def take(self, entries: Sequence[FaultEntry], zero: Instant) -> list[TextEvent]:
        """``entries``: in run time. The events are on the bench clock, in order of time."""
        told: list[TextEvent] = []
        windows = self._windows
        for entry in entries:
            at, code = Instant(zero + entry[0]), entry[6]
            if code not in _IN_WINDOWS:
                told.append(TextEvent(at, "WARN", f"injected: {_in_words(entry)}"))
                continue
            # Where every frame is delayed, all but the first come here.
            window = windows.get((code, entry[7]))
            if window is not None and at - window.last <= WINDOW_GAP:
                window.last = max(window.last, at)
                window.count += 1
                continue
            if window is not None:
                told.append(_closed(window))
            windows[code, entry[7]] = _Window(_struck(entry), at)
            told.append(TextEvent(at, "WARN", f"injected from here: {_struck(entry)}{_first(entry)}"))
        return sorted(told, key=lambda event: event.at)

    def finish(self) -> list[TextEvent]:
        """The windows that are still open."""
        told = [_closed(window) for window in self._windows.values()]
        self._windows.clear()
        return sorted(told, key=lambda event: event.at)


def _closed(window: _Window) -> TextEvent:
    lasted_ms = (window.last - window.first) / NS_PER_MS
    times = "once" if window.count == 1 else f"{window.count} times within {lasted_ms:g} ms"
    return TextEvent(window.last, "INFO", f"injected until here: {window.what}, {times}")


def _struck(entry: FaultEntry) -> str:
    """The kind and where."""
    kind = entry.kind
    if kind in HOST_KINDS:
        return kind.replace("_", " ")
    if kind == "late":
        return f"late, node {entry.link}"
    place = f" at node {entry.at_drive}" if entry.at_drive else ""
    return f"{kind} {entry.direction.label}{place}".replace("_", " ")


def _first(entry: FaultEntry) -> str:
    if entry.kind in HOST_KINDS:
        return f", first by {entry.a / NS_PER_MS:g} ms"
    return f", first frame {entry.can_id & ~EXTENDED_FLAG:03X}h"


def _in_words(entry: FaultEntry) -> str:
    """What befell a node."""
    event = NodeEvent(entry.at_ns, entry.kind, entry.a, entry.b, entry.c)
    return node_kind(entry.kind).in_words(entry.kind, f"node {entry.link}", event)
