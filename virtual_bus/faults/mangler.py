"""Signals in PDOs altered on their way over one connection, in front of whatever else befalls the frames.

    frame --> Mangler: learns mappings, alters values --> FateSource: loses, damages, holds --> on

An altered frame meets the other faults as any frame does. Where no plan has a signal there is no mangler.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

from servobench.drivers.timebase import Duration, Instant
from servobench.virtual_bus.bus.judge import LOST, Direction
from servobench.virtual_bus.faults.alterations import Alteration, saturated
from servobench.virtual_bus.faults.fates import FateSource, Route
from servobench.virtual_bus.faults.fault_log import AT_NODE, KIND_CODES, FaultEntry, FaultLog
from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.kinds.signal import BITS_AT, SignalFault
from servobench.virtual_bus.faults.mapped_objects import SeenMappings, SeenObject
from servobench.virtual_bus.faults.register import LOG_KINDS
from servobench.virtual_bus.frame import Frame

_NOWHERE: Final = KIND_CODES["signal_nowhere"]
_KINDS: Final = [kind.name for kind in LOG_KINDS if kind.alters]
_BITS_MAX: Final = 32
"""No object of CiA 402 is longer; a value of more would not fit into an entry of the log."""
_PDOS: Final = range(0x180, 0x700)
"""Where a PDO may be (CiA 301 7.3.5, table 40), but for the SDOs among them."""


class Note(NamedTuple):
    """An entry of the log for one frame."""

    code: int
    a: int
    b: int
    c: int


class SignalSource(Protocol):
    """Decides about the signals of one connection."""

    def needs(self, way: int, can_id: int) -> bool:
        """Return True if the data of frames with that identifier must be inspected."""

    def meet(self, way: int, frame: Frame, n: int, elapsed: int | None) -> tuple[bytes, list[Note]]:
        """Return the new data of the ``n``-th frame; ``elapsed`` None: before time zero or after the end."""

    def restart(self) -> None:
        """Time zero."""


class Mangler(FateSource):
    """``source`` decides about signals, ``inner`` about everything else."""

    def __init__(self, source: SignalSource, inner: FateSource, log: FaultLog | None, node: int = 0) -> None:
        """``log``, ``node``: see :class:`FateSource`."""
        super().__init__([], frozenset(), log, node)
        self._source = source
        self._inner = inner
        self._altered = [dict.fromkeys(_KINDS, 0) for _ in Direction]
        self._seen: dict[tuple[int, int], int] = {}
        self._started: Instant | None = None
        self._looked_at = False
        self._met = (0, Instant(0), 0)
        """The present frame: its direction, now, and the answer of ``inner``."""

    def start(self, now: Instant) -> None:
        """See :class:`FateSource`."""
        self._started = now
        self._seen.clear()
        self._altered = [dict.fromkeys(_KINDS, 0) for _ in Direction]
        self._source.restart()
        self._inner.start(now)

    def stop(self) -> None:
        """See :class:`FateSource`."""
        self._started = None
        self._inner.stop()

    def route(self, way: int, can_id: int, extended: bool) -> Route:
        """See :class:`FateSource`."""
        return self._inner.route(way, can_id, extended)

    def hold(self, way: int, can_id: int, now: Instant, extended: bool) -> int:
        """See :class:`servobench.virtual_bus.bus.judge.Judge`: a frame whose data matter does not go on as it
        is."""
        held = self._inner.hold(way, can_id, now, extended)
        self._looked_at = not extended and self._source.needs(way, can_id)
        if not self._looked_at:
            return held
        self._met = way, now, held
        return LOST

    def replacements(self, frame: Frame) -> Sequence[tuple[Frame, Duration]]:
        """See :class:`servobench.virtual_bus.bus.judge.Judge`."""
        if not self._looked_at:
            return self._inner.replacements(frame)
        way, now, held = self._met
        elapsed, n = None, 0
        if self._started is not None:
            elapsed = now - self._started
            n = self._seen.get((way, frame.can_id), 0)
            self._seen[way, frame.can_id] = n + 1
        data, notes = self._source.meet(way, frame, n, elapsed)
        for code, a, b, c in notes:
            if code != _NOWHERE:
                self._altered[way][LOG_KINDS[code].name] += 1
            if self.log is not None and elapsed is not None:
                self.log.note(code, elapsed, self._place + way, frame.can_id, n, a, b, c)
        if data != frame.data:
            altered = Frame(frame.can_id, data, frame.extended, frame.remote, frame.remote_length)
            altered.handed_at = frame.handed_at
            frame = altered
        return self._inner.replacements(frame) if held == LOST else [(frame, Duration(held))]

    def counts(self) -> dict[str, dict[str, int]]:
        """See :class:`FateSource`; the frames altered too, by kind."""
        return {
            label: counted | {kind: times for kind, times in altered.items() if times}
            for (label, counted), altered in zip(self._inner.counts().items(), self._altered, strict=True)
        }


class DrawnSignals:
    """By the signals of a plan, with the random streams of ``seed`` on ``link``."""

    def __init__(self, signals: Sequence[SignalFault], seed: int, link: str) -> None:
        self._signals = signals
        self._seed = seed
        self._link = link
        self._mappings = SeenMappings()
        self._revision = -1
        self._at_work: dict[tuple[int, int, int], Alteration] = {}
        self._by_pdo: dict[tuple[int, int], list[tuple[SignalFault, SeenObject, Alteration]]] = {}
        self._unseen = set(signals)
        """Those not met yet, and not said to be nowhere."""

    def restart(self) -> None:
        """See :class:`SignalSource`; every stream begins anew."""
        self._at_work = {}
        self._unseen = set(self._signals)
        self._revision = -1

    def needs(self, way: int, can_id: int) -> bool:  # noqa: ARG002
        """See :class:`SignalSource`: every PDO, for a signal may be in none."""
        return self._mappings.teaches(can_id) or can_id in _PDOS

    def meet(self, way: int, frame: Frame, n: int, elapsed: int | None) -> tuple[bytes, list[Note]]:  # noqa: ARG002
        """See :class:`SignalSource`."""
        if self._mappings.teaches(frame.can_id):
            self._mappings.watch(way, frame)
            return frame.data, []
        if elapsed is None or frame.remote:
            return frame.data, []
        if self._revision != self._mappings.revision:
            self._revision = self._mappings.revision
            self._by_pdo = {}
        notes = list(self._nowhere(elapsed)) if self._unseen else []
        data = frame.data
        for signal, where, alteration in self._on(way, frame.can_id):
            data, note = _altered(signal, where, alteration, data, elapsed)
            notes += note
        return data, notes

    def _on(self, way: int, can_id: int) -> list[tuple[SignalFault, SeenObject, Alteration]]:
        here = self._by_pdo.get((way, can_id))
        if here is None:
            objects = self._mappings.objects(way, can_id)
            here = self._by_pdo[way, can_id] = [
                (signal, where, self._alteration(place, signal, way, where.node))
                for place, signal in enumerate(self._signals)
                for where in objects
                if where.place == signal.place
                and where.bits <= _BITS_MAX
                and way in _ways(signal)
                and (not signal.nodes or where.node in signal.nodes)
            ]
        return here

    def _alteration(self, place: int, signal: SignalFault, way: int, node: int) -> Alteration:
        key = place, way, node
        if key not in self._at_work:
            # Named by its place among its own kind and object: another object's signals do not count.
            alike = sum(
                (each.how, each.place) == (signal.how, signal.place) for each in self._signals[:place]
            )
            label = Direction(way).label
            name = f"{self._link}/{label}/{node}/{signal.log_name} {signal.place:06X}/{alike}"
            self._at_work[key] = signal.at_work(UniformStream(self._seed, name))
        return self._at_work[key]

    def _nowhere(self, elapsed: int) -> list[Note]:
        """Say of each signal whose window has opened, once, where no PDO carries it."""
        notes: list[Note] = []
        for signal in [each for each in self._signals if each in self._unseen and each.window[0] <= elapsed]:
            self._unseen.discard(signal)
            ways = _ways(signal)
            nodes = signal.nodes or sorted(self._mappings.nodes)
            without = [node for node in nodes if not self._mappings.carries(node, signal.place, ways)]
            if not signal.nodes:  # one of them is enough
                without = [0] if len(without) == len(nodes) else []
            notes += [Note(_NOWHERE, signal.place, node, 0) for node in without]
        return notes


class ReplayedSignals:
    """Out of the entries of a recorded run; ``node``: see :class:`FateSource`."""

    def __init__(self, entries: Sequence[FaultEntry], node: int) -> None:
        self._entries: dict[tuple[int, int], dict[int, list[FaultEntry]]] = {}
        for entry in entries:
            if entry.link // AT_NODE == node and LOG_KINDS[entry.code].alters:
                of_pdo = self._entries.setdefault((int(entry.direction), entry.can_id), {})
                of_pdo.setdefault(entry.n, []).append(entry)

    @property
    def idle(self) -> bool:
        """Nothing was altered there."""
        return not self._entries

    def restart(self) -> None:
        """See :class:`SignalSource`."""

    def needs(self, way: int, can_id: int) -> bool:
        """See :class:`SignalSource`."""
        return (way, can_id) in self._entries

    def meet(self, way: int, frame: Frame, n: int, elapsed: int | None) -> tuple[bytes, list[Note]]:
        """See :class:`SignalSource`."""
        data = frame.data
        here = [] if elapsed is None else self._entries[way, frame.can_id].get(n, [])
        for entry in here:
            first_bit, bits = entry.b % BITS_AT, entry.b // BITS_AT
            if entry.code != _NOWHERE and first_bit + bits <= 8 * len(data):
                data = _with_field(data, first_bit, bits, entry.c)
        return data, [Note(entry.code, entry.a, entry.b, entry.c) for entry in here]


def _ways(signal: SignalFault) -> tuple[int, ...]:
    return tuple(int(way) for way in Direction if signal.direction in ("both", way.label))


def _altered(
    signal: SignalFault, where: SeenObject, alteration: Alteration, data: bytes, elapsed: int
) -> tuple[bytes, list[Note]]:
    """``data`` with one signal altered; a frame that is too short for it stays."""
    if where.first_bit + where.bits > 8 * len(data):
        return data, []
    mask = (1 << where.bits) - 1
    raw = int.from_bytes(data, "little") >> where.first_bit & mask
    signed = signal.is_signed
    value = alteration.altered(raw - (mask + 1) if signed and raw >> where.bits - 1 else raw, elapsed)
    if value is None:
        return data, []
    now = saturated(value, where.bits, signed) & mask
    note = Note(KIND_CODES[signal.log_name], where.place, where.bits * BITS_AT + where.first_bit, now)
    return _with_field(data, where.first_bit, where.bits, now), [note]


def _with_field(data: bytes, first_bit: int, bits: int, raw: int) -> bytes:
    image = int.from_bytes(data, "little") & ~((1 << bits) - 1 << first_bit)
    return (image | raw << first_bit).to_bytes(len(data), "little")
