"""Of which SYNC a drive told its torque demand, and which stamps of its changes are to be trusted.

A frame that carries the speed beside the demand is its reading, and so is its SYNC. A frame of its own has no
stamp; as the drive sends one behind each reading, its place among them tells:

    SYNC ends      1          2          3          4          5
    readings         |1         |2                    |4         |5     3 was lost
    demands            :1         :2         :?         :4         :5
                                              3: behind reading 2, before 4, and 3 had ended by then

A demand may only be of a SYNC that ended before it came. So where order tells less, as with readings that
overtake one another, come twice or were lost, it is of an instant from one to another. It is placed when the
next reading has come, as two demands behind one reading show that they are not in order.
"""

from typing import Final

from mypy_extensions import mypyc_attr

from servobench.drivers.exchange import DemandChange, Readback, Reading
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.syncs import REMEMBERED, SyncLog, SyncMark

READINGS_REMEMBERED: Final = 64
"""Readings that a demand may come behind."""
DOUBTED_FOR: Final = 1000
"""Readings without a frame that came twice or was overtaken until order is trusted again: what does so once
in a thousand frames does it to two neighbours once in a million, and one alone is seen."""
SILENT_PERIODS: Final = 4
"""A demand waits so long for the next reading: longer than a few losses in a row, shorter than a row does."""


@mypyc_attr(acyclic=True, free_list_len=1)
class Telling:
    """The drive followed ``demand_raw`` at an instant from ``since`` to ``until``."""

    __slots__ = ("demand_raw", "received_at", "since", "sync", "until")

    def __init__(self, readback: Readback, since: Instant, until: Instant, sync: SyncMark | None) -> None:
        """``sync``: its SYNC; None if that is not known."""
        self.demand_raw = readback.demand_raw
        self.received_at = readback.received_at
        self.since = since
        self.until = until
        self.sync = sync


@mypyc_attr(acyclic=True, free_list_len=1)
class _Placed:
    """A reading whose SYNC is certain."""

    __slots__ = ("mark", "received_at", "since", "until")

    def __init__(self, mark: SyncMark, received_at: Instant, since: Instant, until: Instant) -> None:
        """``since``, ``until``: it was sampled between them."""
        self.mark = mark
        self.received_at = received_at
        self.since = since
        self.until = until


class ReadbackTie:
    """Places the demands of one drive that come with its SYNCs."""

    def __init__(self, syncs: SyncLog, period: Duration, horizon: int) -> None:
        """``horizon``: periods after which nothing is on its way any more."""
        self.readings = 0
        """Readings taken in, those of the calibration too."""
        self.exact = 0
        """Demands whose SYNC was found."""
        self.inexact = 0
        """Demands of which only a time is known from which to which they may be."""
        self.unordered = 0
        """Demands that came while the order of frames told nothing: no command is told lost by them."""
        self._syncs = syncs
        self._period = period
        self._horizon = Duration(horizon * period)
        self._by_count: list[_Placed | None] = [None] * READINGS_REMEMBERED
        self._by_sync: list[_Placed | None] = [None] * REMEMBERED
        self._pending: list[Readback] = []
        self._newest = 0
        """Number of the newest SYNC that has its reading."""
        self._doubted_until = 0
        """Order is not trusted before so many readings have come."""
        self._behind = False
        """True if a demand has been seen to come behind the reading of its SYNC."""
        self._last = 0
        """Number of the newest SYNC of which the last demand may be; 0 before the first."""
        self._tied = 0
        """Number of the SYNC of the last demand whose SYNC was found."""
        self._spacing = 0
        """SYNCs from one demand to the next: the fewest seen; 0: not known."""

    @property
    def doubtful(self) -> bool:
        """True if the order of frames tells nothing, as some overtook others or came twice lately."""
        return self.readings < self._doubted_until

    def pass_over(self, readings: int) -> None:
        """So many readings came that no demand is to be placed by."""
        for _ in range(readings):
            self.readings += 1
            self._by_count[self.readings % READINGS_REMEMBERED] = None

    def reading(self, sample: Sample | None, received_at: Instant, unordered: bool) -> None:
        """The next reading has been taken in; ``sample``: where it was placed, None: nowhere. ``unordered``:
        it came for the second time, or delays spread so much that frames may overtake one another."""
        self.readings += 1
        placed = None
        mark = self._syncs.last_of(sample.sequence) if sample is not None and sample.certain else None
        if sample is not None and mark is not None:
            error_ns = sample.sampled_at_error_ns
            since, until = Instant(sample.sampled_at - error_ns), Instant(sample.sampled_at + error_ns)
            placed = _Placed(mark, received_at, since, until)
            self._by_sync[mark.number % REMEMBERED] = placed
            unordered = unordered or mark.number <= self._newest
            self._newest = max(self._newest, mark.number)
        if unordered:
            self.doubt()
        self._by_count[self.readings % READINGS_REMEMBERED] = placed

    def take(self, readbacks: list[Readback], *, at_end: bool) -> list[Telling]:
        """What these demands, and those that waited, tell; ``at_end``: no reading comes any more."""
        pending = self._pending
        for readback in readbacks:
            pending.append(readback)
        tellings: list[Telling] = []
        done = 0
        while done < len(pending):
            first = pending[done]
            count = first.readings
            if count > self.readings or (not at_end and self._syncs.awaits_echo(first.received_at)):
                break
            behind = self._placed_at(count)
            if first.in_reading and behind is not None:
                self.exact += 1
                self.unordered += self.doubtful
                self._tied = behind.mark.number
                tellings.append(Telling(first, behind.since, behind.until, behind.mark))
                done += 1
                continue
            if count == self.readings and not (at_end or self.doubtful or self._silent_since(first)):
                break
            slot = [first]
            done += 1
            while done < len(pending) and pending[done].readings == count:
                slot.append(pending[done])
                done += 1
            self._place(slot, behind, tellings)
        if at_end or done == len(pending):
            pending.clear()
        elif done:
            del pending[:done]
        return tellings

    def _silent_since(self, readback: Readback) -> bool:
        return self._syncs.last_on_bus - readback.received_at > SILENT_PERIODS * self._period

    def _placed_at(self, count: int) -> _Placed | None:
        """The reading that was the ``count``-th; None if its SYNC is not certain, or it is forgotten."""
        if not 0 <= self.readings - count < READINGS_REMEMBERED:
            return None
        return self._by_count[count % READINGS_REMEMBERED]

    def doubt(self) -> None:
        """Frames are not in order."""
        self._doubted_until = self.readings + DOUBTED_FOR

    def _place(self, slot: list[Readback], behind: _Placed | None, tellings: list[Telling]) -> None:
        """The demands that came behind one reading and before the next."""
        if behind is not None and not self.doubtful:
            places = self._places(slot, behind, self._placed_at(slot[0].readings + 1))
            if places is not None:
                for place, readback in enumerate(slot):
                    first, last = places[place]
                    tellings.append(self._telling(readback, first, last))
                return
            self.doubt()
        for readback in slot:
            newest = self._newest_before(readback)
            since = Instant(readback.received_at - self._horizon)
            until = self._until(newest, readback)
            self.inexact += 1
            self.unordered += self.doubtful
            self._last = max(self._last, newest)
            tellings.append(Telling(readback, since, until, None))

    def _places(
        self, slot: list[Readback], before: _Placed, after: _Placed | None
    ) -> list[tuple[int, int]] | None:
        """First and last SYNC that each may be of, by number; None if they cannot be in order.

        ``before``: the reading that they came behind; ``after``: the next one, of whose SYNC a demand may be
        that came more than half a period behind ``before``, where demands come behind their readings too.
        """
        number = before.mark.number
        first = number
        if self._last and self._spacing:
            # One that is missing may have been overtaken by its reading alone.
            first = max(min(number, self._last + self._spacing), max(1, number - READINGS_REMEMBERED))
        found: list[tuple[int, int]] = []
        step = 1 if first == number else 0  # one that was overtaken may be any of them
        for place, readback in enumerate(slot):
            last = self._newest_before(readback)
            if after is not None:
                soon = readback.received_at - before.received_at <= self._period // 2
                limit = after.mark.number - 1 if self._behind and soon else after.mark.number
                last = min(last, limit - (len(slot) - 1 - place))
            first = self._on_bus_from(first, last)
            if last < first or last < number:
                return None
            found.append((first, last))
            first += step
        if found[0] == (number, number):
            if self._tied == number:
                return None  # it has its demand, and this is one that came twice, or late
            self._behind = True
        return found

    def _telling(self, readback: Readback, first: int, last: int) -> Telling:
        known = self._last
        self._last = max(known, last)
        placed = self._by_sync[last % REMEMBERED]
        alone = placed is None or placed.mark.number != last or not self._may_hide_another(placed, readback)
        if first < last or not alone:
            self.inexact += 1
            return Telling(readback, self._since(first), self._until(last, readback), None)
        self.exact += 1
        self._tied = last
        if known and last > known and (not self._spacing or last - known < self._spacing):
            self._spacing = last - known
        return Telling(readback, self._since(first), self._until(last, readback), self._mark(last))

    def _since(self, number: int) -> Instant:
        """No drive sampled at this SYNC before."""
        placed = self._by_sync[number % REMEMBERED]
        if placed is not None and placed.mark.number == number:
            return placed.since
        mark = self._mark(number)
        ended_at = mark.handed_at if mark.on_bus_at is None else mark.on_bus_at - mark.late_ns
        return Instant(ended_at - self._syncs.error_ns)

    def _until(self, number: int, readback: Readback) -> Instant:
        """No drive sampled at this SYNC later, if ``readback`` is of it or of one before."""
        placed = self._by_sync[number % REMEMBERED]
        if placed is None or placed.mark.number != number or self._may_hide_another(placed, readback):
            return readback.received_at
        return placed.until

    def _may_hide_another(self, placed: _Placed, readback: Readback) -> bool:
        """Return whether a demand that came behind a reading may be of a later SYNC: another node's, which
        this host may not have heard."""
        on_bus_at = placed.mark.on_bus_at
        if not self._syncs.of_another or readback.received_at - placed.received_at <= self._period // 2:
            return False
        return on_bus_at is None or readback.received_at - on_bus_at > self._period // 2

    def _mark(self, number: int) -> SyncMark:
        marks = self._syncs.marks
        return marks[max(0, number - marks[0].number)]

    def _newest_before(self, readback: Readback) -> int:
        """Number of the last SYNC that had ended when a demand came, or may have, unheard; 0: of none that is
        remembered."""
        at = Instant(readback.received_at + self._syncs.error_ns)
        for mark in reversed(self._syncs.marks):
            if mark.ended_by(at):
                return mark.number
        return 0

    def _on_bus_from(self, number: int, last: int) -> int:
        """The first SYNC from ``number`` on that was on the bus, or may have been; none beyond ``last``."""
        while number < last:
            mark = self._mark(number)
            if mark.on_bus_at is not None or mark.hidden:
                break
            number += 1
        return number


class ProvedChanges:
    """Demands that a drive stamped when they changed, until the map of its clock is known to hold there.

    That is when readings stamped before it and after it have been placed for certain: a clock that was set in
    between would have put a question.

        readings     :1         :2         :3
        change             :c                      proved with reading 2
    """

    def __init__(self, settled: int) -> None:
        """``settled``: where delays spread, a certain reading may be taken back until so many more came."""
        self._pending: list[DemandChange] = []
        self._stamps = [0] * (settled + 1)
        """A ring, of the last readings that were placed for certain in a row."""
        self._certain = 0
        """So many were in a row."""
        self._since_ns = 0
        """Of the first of them."""

    def reading(self, reading: Reading, *, certain: bool) -> None:
        """The next reading with a stamp was placed."""
        if not certain:
            self._certain = 0
            self._pending.clear()
            return
        device_ns = reading.device_time_ns
        if device_ns is None:
            return
        if self._certain == 0:
            self._since_ns = device_ns
        self._stamps[self._certain % len(self._stamps)] = device_ns
        self._certain += 1

    def take(self, changes: list[DemandChange], *, spread: bool) -> list[DemandChange]:
        """Those of ``changes``, and of the ones that waited, that are proved now."""
        pending, stamps, certain = self._pending, self._stamps, self._certain
        pending.extend(changes)
        if not pending:
            return pending
        if certain == 0:
            pending.clear()
            return []
        if spread and certain < len(stamps):
            return []
        until_ns = stamps[(certain if spread else certain - 1) % len(stamps)]
        proved = [change for change in pending if self._since_ns <= change.device_time_ns <= until_ns]
        self._pending = [change for change in pending if change.device_time_ns > until_ns]
        return proved
