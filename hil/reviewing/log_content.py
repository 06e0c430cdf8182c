"""A log of whatever program, read once by columns: SYNCs, PDOs with their objects, and what else was said.

PDOs of a log against its SYNCs: what came in which cycle, how long after it, what did not come.

    SYNC     |        |        |        |        |
    TPDO1      .         .                .  .       .
    cycle    answered  answered lost?    two         answered

A cycle lasts from a SYNC to the next. A frame answers the SYNC before it; where a cycle without one is
followed by a cycle with two, the first of the two is late and answers the SYNC before that. Whether a frame
that comes about a period after its SYNC answers it or the next cannot be told from a log: it is marked.
"""

from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.canopen.cob_ids import NODE_BITS, SYNC
from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.reviewing.trace.decoder import BusDecoder
from servobench.hil.reviewing.trace.frame_columns import CLASSICAL_BYTES_MAX, LogFrame
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


_EVENT_SHARE: Final = 0.8
"""A PDO whose transmission type nobody told is synchronous if so many cycles have exactly one."""
_FILLED: Final = 0.9
"""Of the period: a delay beyond leaves open which SYNC was answered."""
_EVERY_MAX: Final = 240
"""Largest number of SYNCs to one PDO (CiA 301 7.5.2.36)."""


@dataclass(frozen=True, slots=True)
class SyncGrid:
    """Cycles of a log: its SYNCs, and those that were due in between and are not there."""

    at: Instants
    """(n,) ns as the log counts; of a missing one when it was due."""
    there: NDArray[np.bool_]
    """(n,) False: no SYNC."""
    judged: NDArray[np.bool_]
    """(n,) False: what follows it was not recorded, so nothing can be said to be missing."""
    period_ns: int
    """Median distance."""
    jitter_ns: int
    """Largest deviation of a distance between SYNCs that follow one another from the median."""

    @property
    def missed(self) -> int:
        return int(np.count_nonzero(~self.there))


def sync_grid(syncs: Instants, silences: list[tuple[int, int]], period_ns: int, end_ns: int) -> SyncGrid:
    """Return the grid of ``syncs``: (n,), n >= 2; ``period_ns``: what the bench has, taken where it fits.

    A distance of several periods holds missed ones, one within ``silences`` does not.
    """
    gaps = np.diff(syncs)
    median = int(np.median(gaps))
    period = period_ns if abs(median - period_ns) * 20 < period_ns else median
    lacking = np.maximum(0, np.round(gaps / period).astype(np.int64) - 1)
    silent = np.zeros(gaps.size, np.bool_)
    for begin, end in silences:
        silent |= (syncs[:-1] <= end) & (syncs[1:] >= begin) & (gaps > end - begin - period)
    lacking[silent] = 0
    followed = gaps[(lacking == 0) & ~silent]
    behind = np.repeat(np.arange(gaps.size), lacking)
    step = np.arange(behind.size) - np.repeat(np.cumsum(lacking) - lacking, lacking) + 1
    missing_at = syncs[behind] + (gaps[behind] * step) // (lacking[behind] + 1)
    at = np.concatenate((syncs, missing_at))
    there = np.arange(at.size) < syncs.size
    judged = np.concatenate((~silent, [end_ns - int(syncs[-1]) >= period], np.ones(behind.size, np.bool_)))
    order = np.argsort(at, kind="stable")
    jitter = int(np.abs(followed - median).max()) if followed.size else 0
    return SyncGrid(at[order], there[order], judged[order], median, jitter)


@dataclass(frozen=True, slots=True)
class CyclicPdo:
    """A PDO by cycle. Arrays have the cycles of the grid."""

    every: int | None
    """It comes with each n-th SYNC; None: by event."""
    frames: int
    expected: NDArray[np.bool_]
    """(n,) It was to come: from the first cycle with one to the last."""
    delay_ns: Instants
    """(n,) SYNC to frame; -1: none came."""
    received_at: Instants
    """(n,) ns as the log counts; -1: none came."""
    late: NDArray[np.bool_]
    """(n,) It came after the next SYNC."""
    uncertain: NDArray[np.bool_]
    """(n,) Whether it answers this SYNC or the next cannot be told."""
    extra: int
    """Frames that answer no SYNC of their own."""
    behind: int
    """Cycles after the last one with a frame."""

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(n,) It was to come, and did not."""
        return self.expected & (self.delay_ns < 0)

    def in_a_row(self) -> int:
        """Return how many were lost in a row at most."""
        lost = self.lost[self.expected]
        numbers = np.arange(lost.size)
        runs = numbers - np.maximum.accumulate(np.where(lost, -1, numbers))
        return int(runs.max()) if lost.size else 0


def cyclic_pdo(at: Instants, grid: SyncGrid, transmission_type: int | None) -> CyclicPdo:
    """Return a PDO whose frames came ``at``: (m,) ns, m >= 1.

    ``transmission_type``: as told (CiA 301 7.5.2.36); None: nobody did, the frames themselves say it.
    """
    count = grid.at.size
    place = np.searchsorted(grid.at, at, side="right") - 1
    known = place >= 0
    at, place = at[known], place[known]
    number = np.bincount(place, minlength=count)
    delay, received = np.full(count, -1, np.int64), np.full(count, -1, np.int64)
    late, uncertain = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    expected = np.zeros(count, np.bool_)
    if not at.size:
        return CyclicPdo(None, 0, expected, delay, received, late, uncertain, 0, 0)
    first, last = int(place[0]), int(place[-1])
    every = _every(number[first : last + 1], transmission_type)
    begins = np.searchsorted(place, np.arange(count), side="left")
    answered = np.flatnonzero(number)
    received[answered] = at[begins[answered]]
    if every is not None:
        phase = int(np.bincount(place % every, minlength=every).argmax())
        expected[first : last + 1] = np.arange(first, last + 1) % every == phase
        expected &= grid.there & grid.judged
        twice = np.flatnonzero(number[1:] >= 2) + 1
        twice = twice[(number[twice - 1] == 0) & expected[twice - 1]]
        received[twice - 1], late[twice - 1] = at[begins[twice]], True
        received[twice] = at[begins[twice] + 1]
        number[twice] -= 1
    came = received >= 0
    delay[came] = received[came] - grid.at[came]
    if every is not None:
        uncertain = came & (delay > _FILLED * grid.period_ns)
    spare = int(np.maximum(number - 1, 0).sum()) if every is not None else 0
    behind = int(np.count_nonzero(grid.there[last + 1 :] & grid.judged[last + 1 :]))
    return CyclicPdo(every, at.size, expected, delay, received, late, uncertain, spare, behind)


def _every(number: NDArray[np.int64], transmission_type: int | None) -> int | None:
    """``number``: (n,) of frames in each cycle from the first to the last that has one."""
    if transmission_type is not None:
        return transmission_type if 1 <= transmission_type <= _EVERY_MAX else None
    with_one = np.flatnonzero(number)
    every = int(np.median(np.diff(with_one))) if with_one.size > 1 else 1
    steps = max(1, (number.size - 1) // every + 1)
    exactly = np.count_nonzero(number == 1) / steps
    return every if 1 <= every <= _EVERY_MAX and _EVENT_SHARE <= exactly <= 1.0 else None


def percentiles_us(delays_ns: Instants) -> tuple[float, float, float] | None:
    """Return p50, p99 and the largest; None: there are none."""
    if not delays_ns.size:
        return None
    p50, p99 = np.quantile(delays_ns, (0.5, 0.99), method="inverted_cdf")
    return float(p50) / 1e3, float(p99) / 1e3, float(delays_ns.max()) / 1e3


def within_cycle(at: Instants, values: NDArray[np.float64], grid: SyncGrid) -> NDArray[np.float64]:
    """(n,) The last of ``values``, which came ``at``: (m,), in each cycle; NaN: none did."""
    ends = np.append(grid.at[1:], np.iinfo(np.int64).max)
    place = np.searchsorted(at, ends, side="left") - 1
    found = np.full(grid.at.size, np.nan)
    told = place >= 0
    told[told] = at[place[told]] >= grid.at[told]
    found[told] = values[place[told]]
    return found


def held_values(at: Instants, values: NDArray[np.float64], grid: SyncGrid) -> NDArray[np.float64]:
    """(n,) The last of ``values``, which came ``at``: (m,), up to the end of each cycle; NaN before them."""
    place = np.searchsorted(at, np.append(grid.at[1:], np.iinfo(np.int64).max), side="left") - 1
    return np.where(place >= 0, values[np.maximum(place, 0)], np.nan)
