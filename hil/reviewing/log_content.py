"""A log of whatever program, read once by columns: SYNCs, PDOs with their objects, and what else was said."""

from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.canopen.cob_ids import NODE_BITS, SYNC
from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.reviewing.trace.decoder import BusDecoder
from servobench.hil.reviewing.trace.log_frame import CLASSICAL_BYTES_MAX, LogFrame
from servobench.hil.reviewing.trace.node_objects import KnownNodes
from servobench.hil.reviewing.trace.pdo_book import PdoLayout, columns_of
from servobench.hil.reviewing.trace.trace_entry import TraceEntry

Instants = NDArray[np.int64]
SILENCE_NS: Final = 100 * NS_PER_MS
"""No drive in operation is silent for so long: nothing was recorded meanwhile."""
_PDO_FIRST, _PDO_LAST = 0x180, 0x57F
_KEPT: Final = frozenset({"emcy", "nmt", "heartbeat", "guarding", "sdo", "error"})
_ENTRIES_MAX: Final = 200_000
"""Entries that are kept: heartbeats of three drives for three quarters of an hour. More are counted."""


class ObjectValues(NamedTuple):
    """Values of an object that a node's PDOs carried, in order of time."""

    at: Instants
    """(n,) ns as the log counts."""
    raw: NDArray[np.float64]
    """(n,)."""
    si: NDArray[np.float64]
    """(n,) in ``unit``; NaN where nobody has told how the drive counts."""
    unit: str


class _Frames:
    """Frames of one identifier under one layout."""

    def __init__(self, layout: PdoLayout | None) -> None:
        self.layout = layout
        self.at = array("q")
        self.words = array("Q")
        self.lengths = bytearray()


class PdoFrames(NamedTuple):
    """The PDOs of one identifier."""

    can_id: int
    node: int
    name: str
    """TPDO1."""
    at: Instants
    """(n,) ns as the log counts."""


class BusContent:
    """One interface of the log."""

    def __init__(self, known: KnownNodes, channel: str) -> None:
        self.channel = channel
        self.decoder = BusDecoder(known, channel)
        self.kinds: Counter[str] = Counter()
        """How many frames or transfers of each kind beside SYNCs and PDOs."""
        self.entries: list[TraceEntry] = []
        """EMCYs, NMT, heartbeats, SDO transfers and error frames."""
        self.silences: list[tuple[int, int]] = []
        """From when to when nothing was recorded, ns."""
        self.frames = 0
        self._syncs, self._counters = array("q"), array("h")
        self._last_ns: int | None = None
        self._groups: dict[int, list[_Frames]] = {}
        self._layouts = -1

    def take(self, frame: LogFrame, at_ns: int) -> None:
        """Take in the next frame."""
        self.frames += 1
        if self._last_ns is not None and at_ns - self._last_ns > SILENCE_NS:
            self.silences.append((self._last_ns, at_ns))
        self._last_ns = at_ns
        can_id, data = frame.can_id, frame.data
        if not (frame.extended or frame.remote or frame.error or frame.fd):
            if can_id == SYNC:
                self._syncs.append(at_ns)
                self._counters.append(data[0] if len(data) == 1 else -1)
                return
            if _PDO_FIRST < can_id <= _PDO_LAST and can_id & NODE_BITS and len(data) <= CLASSICAL_BYTES_MAX:
                group = self._group(can_id)
                group.at.append(at_ns)
                group.words.append(int.from_bytes(data, "little"))
                group.lengths.append(len(data))
                return
        self._keep(self.decoder.take(frame))

    def end(self) -> None:
        """The log ends."""
        self._keep(self.decoder.close())

    @property
    def syncs(self) -> Instants:
        """(n,) ns as the log counts."""
        return np.array(self._syncs, np.int64)

    @property
    def counters(self) -> NDArray[np.int16]:
        """(n,), of the SYNCs; -1: it has none."""
        return np.array(self._counters, np.int16)

    def pdos(self) -> list[PdoFrames]:
        """All PDOs, by identifier."""
        found = []
        for can_id, groups in sorted(self._groups.items()):
            layout = groups[-1].layout
            if layout is not None:
                at = np.concatenate([np.array(group.at, np.int64) for group in groups])
                found.append(PdoFrames(can_id, layout.node, layout.name, at))
        return found

    def objects(self, node: int) -> dict[tuple[int, int], ObjectValues]:
        """The mapped objects of a node, in the units that the log has told in the end."""
        parts: dict[tuple[int, int], list[tuple[Instants, NDArray[np.float64]]]] = {}
        for layout, at, data, length in self._blocks(node):
            for column in columns_of(layout, data, length):
                parts.setdefault(column.key, []).append((at, column.raw.astype(np.float64)))
        return {key: self._values(node, key, part) for key, part in parts.items()}

    def _values(
        self, node: int, key: tuple[int, int], parts: Sequence[tuple[Instants, NDArray[np.float64]]]
    ) -> ObjectValues:
        at, raw = (np.concatenate(part) for part in zip(*parts, strict=True))
        order = np.argsort(at, kind="stable")
        at, raw = at[order], raw[order]
        si, unit = self.decoder.objects(node).in_si(*key, raw)
        return ObjectValues(at, raw, np.full(raw.size, np.nan) if si is None else si, unit)

    def _blocks(self, node: int) -> Iterator[tuple[PdoLayout, Instants, NDArray[np.uint8], int]]:
        """PDOs of one layout and one length."""
        for group in (group for groups in self._groups.values() for group in groups):
            if group.layout is None or group.layout.node != node or not group.layout.objects:
                continue
            lengths = np.frombuffer(bytes(group.lengths), np.uint8)
            at, words = np.array(group.at, np.int64), np.array(group.words, "<u8")
            for length in np.unique(lengths).tolist():
                mine = lengths == length
                yield group.layout, at[mine], words[mine].view(np.uint8).reshape(-1, 8), length

    def _group(self, can_id: int) -> _Frames:
        if self.decoder.mappings != self._layouts:
            self._layouts = self.decoder.mappings
            for known in self._groups:
                self._begin(known)
        groups = self._groups.get(can_id)
        return self._begin(can_id) if groups is None else groups[-1]

    def _begin(self, can_id: int) -> _Frames:
        """Begin a group where the layout is another than before."""
        layout = self.decoder.layout(can_id)
        groups = self._groups.setdefault(can_id, [])
        if not groups or groups[-1].layout != layout:
            groups.append(_Frames(layout))
        return groups[-1]

    def _keep(self, entries: Iterable[TraceEntry]) -> None:
        for entry in entries:
            self.kinds[entry.kind] += 1
            if entry.kind in _KEPT and len(self.entries) < _ENTRIES_MAX:
                self.entries.append(entry)


class LogContent:
    """All of a log."""

    def __init__(self, frames: Iterable[LogFrame], known: KnownNodes) -> None:
        self.buses: dict[str, BusContent] = {}
        """By interface."""
        self.frames = self.timeless = 0
        self.begin_ns = self.end_ns = 0
        for frame in frames:
            self.frames += 1
            at_ns = frame.at_ns
            if at_ns is None:
                self.timeless += 1
                continue
            bus = self.buses.get(frame.channel)
            if bus is None:
                bus = self.buses[frame.channel] = BusContent(known, frame.channel)
                self.begin_ns = self.begin_ns if len(self.buses) > 1 else at_ns
            bus.take(frame, at_ns)
            self.end_ns = at_ns
        for bus in self.buses.values():
            bus.end()
