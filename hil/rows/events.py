"""The events of a run: its time zero, the faults injected into it, and the lines of events.jsonl.

The fault log counts from the first cycle, as all files do, but for the entries of what a drive has from its
power-on: those count from there, which in simulated time is the beginning. Entries wait until the first cycle
is known.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.bounded_file import parse_json
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.frame_port import EXTENDED_FLAG
from servobench.hil.rows.run_files import EVENTS_FILE
from servobench.hil.rows.side_rows import BeginEvent, RunEvent, StateEvent, TextEvent
from servobench.virtual_bus.faults.fault_log import (
    BLOCK,
    BLOCK_BYTES,
    HOST_KINDS,
    FaultEntry,
    entries_of,
)
from servobench.virtual_bus.faults.fault_table import NONE
from servobench.virtual_bus.faults.kinds.host_stall import HostStall
from servobench.virtual_bus.faults.node_fault import NodeEvent
from servobench.virtual_bus.faults.node_faults import node_kind
from servobench.virtual_bus.faults.register import LOG_KINDS


def event_json(event: TextEvent | StateEvent | BeginEvent, zero: Instant) -> dict[str, object]:
    """Return an entry of events.jsonl; ``zero``: the first cycle."""
    at = {"at_ns": event.at - zero}
    if isinstance(event, TextEvent):
        return {**at, "level": event.level, "text": event.text}
    if isinstance(event, BeginEvent):
        return {**at, "begin": True}
    return {**at, "track": event.track, "state": event.label}


def read_events(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the entries of an events.jsonl; an invalid one, such as a truncated line, is skipped."""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        with suppress(BadInput):
            event = parse_json(line, EVENTS_FILE, "an event")
            if isinstance(event, dict) and isinstance(event.get("at_ns"), int):
                yield event


class RunZero:
    """The instant of the first cycle on the bench clock: origin of all times of a recording."""

    def __init__(self, started_at: Instant) -> None:
        """``started_at``: of the recording; used if no first cycle ever came."""
        self.at = started_at
        self.told = False

    def look(self, events: Sequence[RunEvent]) -> bool:
        """Return True if one of ``events`` is the first cycle."""
        for event in events:
            if isinstance(event, BeginEvent):
                self.at, self.told = event.at, True
                return True
        return False


WINDOW_GAP: Final = Duration(NS_PER_S // 2)
"""Strikes of one fault at most this far apart form one window: a loss of 1 % of the readings of one axis at 1
kHz strikes every 100 ms, and leaves such a gap once in 15 s."""
INJECTED_TRACK: Final = "injected "
"""Prefix of a fault's track; its kind, ": ", and the place follow."""
ACTIVE, QUIET = "active", "-"
"""Its states."""
PARTS: Final = ("current", "supply", "stops", "switches", "brake")
"""Tracks of an axis whose drive the bench simulates: what in it, or in its machine, is not as usual."""
_IN_WINDOWS: Final = frozenset(code for code, kind in enumerate(LOG_KINDS) if kind.in_windows)


class _Window:
    """Strikes of one fault in a row."""

    def __init__(self, kind: str, what: str, at: Instant) -> None:
        self.kind = kind
        self.what = what
        self.first = self.last = at
        self.count = 1


class InjectedFaults:
    """Turns entries into events as they come."""

    def __init__(self) -> None:
        self._windows: dict[tuple[int, int, int], _Window] = {}
        """Open windows, by kind, link and, for some kinds, the struck item."""
        self._lasting: list[tuple[Instant, str]] = []
        """Faults of nodes that end by themselves: when, and their tracks."""
        self._until_taken_back: dict[str, int] = {}
        """Faults without an end, by track: the number that an opposite one cancels."""

    def take(self, entries: Sequence[FaultEntry], zero: Instant) -> list[TextEvent | StateEvent]:
        """Take ``entries`` in run time. The events are on the bench clock, in order of time."""
        told: list[TextEvent | StateEvent] = []
        windows = self._windows
        for entry in entries:
            at, code = Instant(zero + entry[0]), entry[6]
            kind = LOG_KINDS[code]
            if kind.says is not None:
                told.append(TextEvent(at, "WARN", f"not injected: {kind.says(entry.a, entry.b)}"))
                continue
            if code not in _IN_WINDOWS:
                told.append(TextEvent(at, "WARN", f"injected: {_in_words(entry)}"))
                told.append(self._node_state(entry, at))
                continue
            # Where every frame is delayed, all but the first come here.
            key = code, entry[7], 0 if kind.of is None else entry.a
            window = windows.get(key)
            if window is not None and at - window.last <= WINDOW_GAP:
                window.last = max(window.last, at)
                window.count += 1
                continue
            if window is not None:
                told += _closed(window)
            struck = _struck(entry)
            windows[key] = _Window(entry.kind, struck, at)
            told.append(TextEvent(at, "WARN", f"injected from here: {struck}{_first(entry)}"))
            told.append(StateEvent(at, _track(entry.kind, struck), ACTIVE))
        return sorted(told, key=lambda event: event.at)

    def _node_state(self, entry: FaultEntry, at: Instant) -> StateEvent:
        track = _track(entry.kind, f"node {entry.link}")
        lasts_ns = node_kind(entry.kind).lasts_ns(_node_event(entry))
        if lasts_ns != NONE:
            self._lasting.append((Instant(at + lasts_ns), track))
        elif self._until_taken_back.get(track) == -entry.a:
            del self._until_taken_back[track]
            return StateEvent(at, track, QUIET)
        else:
            self._until_taken_back[track] = entry.a
        return StateEvent(at, track, ACTIVE)

    def ended(self, until: Instant) -> list[StateEvent]:
        """Return the ends of node faults up to ``until``, except those already reported."""
        over = [(at, track) for at, track in self._lasting if at <= until]
        self._lasting = [(at, track) for at, track in self._lasting if at > until]
        return [StateEvent(at, track, QUIET) for at, track in sorted(over)]

    def finish(self) -> list[TextEvent | StateEvent]:
        """Return the windows still open."""
        told = [event for window in self._windows.values() for event in _closed(window)]
        self._windows.clear()
        return sorted(told, key=lambda event: event.at)


def _track(kind: str, what: str) -> str:
    return f"{INJECTED_TRACK}{kind.replace('_', ' ')}: {what}"


def _closed(window: _Window) -> list[TextEvent | StateEvent]:
    lasted_ms = (window.last - window.first) / NS_PER_MS
    times = "once" if window.count == 1 else f"{window.count} times within {lasted_ms:g} ms"
    return [
        TextEvent(window.last, "INFO", f"injected until here: {window.what}, {times}"),
        StateEvent(window.last, _track(window.kind, window.what), QUIET),
    ]


def _struck(entry: FaultEntry) -> str:
    """Return the kind and place."""
    kind = entry.kind
    if kind in HOST_KINDS:
        return kind.replace("_", " ")
    if kind == "late":
        return f"late, node {entry.link}"
    of = LOG_KINDS[entry.code].of
    what = kind if of is None else f"{kind} {of(entry.a, entry.b)}"
    place = f" at node {entry.at_drive}" if entry.at_drive else ""
    return f"{what} {entry.direction.label}{place}".replace("_", " ")


def _first(entry: FaultEntry) -> str:
    if entry.kind in HOST_KINDS:
        return f", first {'by' if entry.kind == HostStall.kind else 'for'} {entry.a / NS_PER_MS:g} ms"
    return f", first frame {entry.can_id & ~EXTENDED_FLAG:03X}h"


def _in_words(entry: FaultEntry) -> str:
    """Describe a fault of a node."""
    return node_kind(entry.kind).in_words(entry.kind, f"node {entry.link}", _node_event(entry))


def _node_event(entry: FaultEntry) -> NodeEvent:
    return NodeEvent(entry.at_ns, entry.kind, entry.a, entry.b, entry.c)


ENTRY_DTYPE: Final = np.dtype([(name, "<i8") for name in FaultEntry._fields])
"""An entry of the fault log, as it lies in a block."""
BLOCK_DTYPE = np.dtype([("length", "<u4"), ("block", "u1", (BLOCK_BYTES,))])
assert BLOCK_DTYPE.itemsize == BLOCK.size
_SINCE_POWER_ON = [code for code, kind in enumerate(LOG_KINDS) if kind.since_power_on]


class FaultEntries:
    """The entries of a run in run time, as its ring brings them."""

    def __init__(self, started_at: Instant) -> None:
        """``started_at``: when the drives were switched on."""
        self.fresh = np.empty(0, ENTRY_DTYPE)
        """Those of the last :meth:`take`, (n,)."""
        self._started_at = started_at
        self._early = b""

    def take(self, blocks: NDArray[np.void], zero: RunZero, at_end: bool = False) -> list[FaultEntry]:
        """Those in ``blocks``: (n,) of BLOCK_DTYPE. They wait for the first cycle, unless it never comes."""
        for row in blocks:
            self._early += row["block"].tobytes()[: int(row["length"])]
        ready = self._early if zero.told or at_end else b""
        self._early = self._early[len(ready) :]
        self.fresh = np.frombuffer(ready, ENTRY_DTYPE).copy()
        self.fresh["at_ns"][np.isin(self.fresh["code"], _SINCE_POWER_ON)] += self._started_at - zero.at
        return list(entries_of(self.fresh.tobytes()))
