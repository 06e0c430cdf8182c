"""The SYNCs of one segment, each with the instant of its end on the bus.

The instant comes from the SYNC's own echo. A bus without echoes has the instant of the hand-over instead,
plus the time of the frame on an idle bus; the SYNC may have ended later than that.

    handed over   1       2       3                4
    on the bus      1       2          ?               4      3 has not come back: lost in front of the bus

A SYNC carries no number. A simulated bus and a hub tell with an echo when its frame had been handed over. On
other buses echoes come in the order of handing over, and none is from before its own. While one echo is
awaited, it is the echo of that SYNC. Where a SYNC was given up and a later one handed over, one echo from
after both may be that of either: they are then unsure, unless the other echo comes too.
"""

from typing import Final

from mypy_extensions import mypyc_attr

from servobench.drivers.timebase import NEVER, NS_PER_US, Duration, Instant
from servobench.drivers.wire.frame_port import UNTOLD, EchoBasis
from servobench.hil.loop.residuals import Extremes

ECHO_ERROR: Final = {
    EchoBasis.BUS: 0,
    EchoBasis.HARDWARE: NS_PER_US,
    EchoBasis.KERNEL: 30 * NS_PER_US,
    EchoBasis.RECEIPT: 100 * NS_PER_US,
    EchoBasis.NONE: 30 * NS_PER_US,
}
"""How far the instant of an echo may lie from the end of its frame: none where it is computed, a tick of the
adapter's clock, the latency of an interrupt, that of a wake-up. Without echoes: jitter of the hand-over."""
STAMPED_LATE: Final = (EchoBasis.KERNEL, EchoBasis.RECEIPT)
"""Here an echo may be stamped any time after the end of its frame; else the instant is that end or, for a
SYNC that waited in front of a bus without echoes, before it."""
LATE_WITHOUT_BOUND: Final = 1 << 60
"""By how much such an echo may be stamped after the end of its frame, ns: only the hand-over is before it."""
HORIZON_MAX: Final = 100
"""Periods after which a reading is lost at the latest."""
REMEMBERED: Final = 128
"""SYNCs that a reading may still answer: more than any horizon is long."""
GIVEN_UP_AFTER_PERIODS: Final = 2
"""An echo that is so late will not come: a frame of the highest priority waits for one frame at most, so its
bus has been stopped or has lost it. The bench goes on, as a drive without SYNC stands still."""
SURPLUS: Final = 0
"""The sequence of a SYNC on the bus that this host did not hand over, or not so often."""


@mypyc_attr(acyclic=True, free_list_len=1)
class SyncMark:
    """One SYNC."""

    def __init__(self, number: int, sequence: int, handed_at: Instant) -> None:
        self.number = number
        """Counted along all SYNCs of the segment, 1, 2, ..., a surplus one included."""
        self.place = number
        """The same, with those counted that are missing, see :attr:`SyncLog.missing`."""
        self.sequence = sequence
        """The cycle it belongs to; :data:`SURPLUS` for none."""
        self.handed_at = handed_at
        self.on_bus_at: Instant | None = None
        """Its end on the bus; None: not known (yet), or it never came there."""
        self.sure = True
        """True if ``on_bus_at`` is certainly this SYNC's."""
        self.late_ns = 0
        """By how much it may have ended before ``on_bus_at``, as its echo took so much longer from the
        hand-over than the quickest of the last ones: it waited in front of the bus, or was stamped late. One
        of another node: as its distances from the others differ."""
        self.late_to_drives = False
        """True if drives may have heard it long after its end, and at one instant with others: no stamp says
        which one it was."""
        self.unsent = False
        """True if it never went out, as the bus had no room for it."""

    @property
    def hidden(self) -> bool:
        """True if it may have been on the bus unheard."""
        return self.on_bus_at is None and not (self.sure or self.unsent)

    def ended_by(self, at: Instant) -> bool:
        """Return whether it had ended by ``at``, or may have, unheard."""
        if self.on_bus_at is None:
            return self.hidden and self.handed_at <= at
        return self.on_bus_at <= at


class SyncLog:
    """Knowledge of the SYNCs of one segment."""

    def __init__(self, latency: Duration, period: Duration, echoes: EchoBasis) -> None:
        """``latency``: from handing a SYNC over until its end on an idle bus."""
        self.marks: list[SyncMark] = []
        """In the order of handing over; the last :data:`REMEMBERED`."""
        self.echoes = self.basis = echoes
        """Basis of the instants of SYNCs on the bus: their echoes, or NONE, the hand-over, see
        :meth:`rest_on_hand_over`."""
        self.error_ns = ECHO_ERROR[echoes]
        """How far such an instant may be off in any case."""
        self.unheard_until = Instant(0)
        """Frames that were on the bus before may not have come, echoes among them."""
        self.surplus = 0
        """SYNCs on the bus that belong to no cycle: echoes beyond what was handed over, another master's."""
        self.missing = 0
        """SYNCs of another node that did not come in their periods: not sent, or lost on the way to this
        host. A drive that heard them answers."""
        self.of_another = False
        """True if another node makes the SYNCs."""
        self.crowded = 0
        """SYNCs that ended on the bus less than half a period after the one before."""
        self._latency = latency
        self._period = period
        self._echoed = echoes is not EchoBasis.NONE
        self._pending: list[SyncMark] = []
        """Those whose echo may still come, in the order of handing over."""
        self._instants: list[Instant] = []
        """Echoes that came while several were pending."""
        self._echo_error = ECHO_ERROR[echoes]
        self._echoes_late = echoes in STAMPED_LATE
        self._ways = Extremes()
        """From the hand-over of a SYNC to its echo; of another node's, what their distances are off."""
        self._late_to_drives = 0
        """Up to this number SYNCs may have come late to drives: an echo from before a hand-over came behind
        it, so the bus itself, a hub, stood still."""
        self.counted = 0
        """SYNCs so far, handed over or heard, surplus ones among them."""
        self.last_on_bus = Instant(-(1 << 62))
        """The end of the last SYNC on the bus."""
        self.heard_ns = 0
        """For how long the bus has been heard of so far: the time from SYNC to SYNC on it, but no more of one
        that came late than a SYNC may take. While a bus stands still, what it is to bring lies there, and it
        comes behind the first SYNC after that."""

    def handed(self, sequence: int, at: Instant) -> SyncMark:
        """A SYNC has been handed over."""
        mark = self._remember(sequence, at)
        if self._echoed:
            if self._instants:
                self._end_doubt()
                mark.sure = False
            self._pending.append(mark)
            if len(self._pending) > REMEMBERED:
                del self._pending[0]
        else:
            self._put_on_bus(mark, Instant(at + self._latency))
        return mark

    def _end_doubt(self) -> None:
        """Fewer echoes came than SYNCs were handed over: the missing one is not waited for any longer.

        The marks stay unsure. An echo that came soon after the last SYNC looks like that SYNC's, but a bus
        that was stopped may give back the one before at just that time, and the last a period later. So the
        next echo may be that of the last SYNC, and is unsure too; the one after it would be from before its
        own hand-over.
        """
        self._pending.clear()
        self._instants.clear()

    def rest_on_hand_over(self) -> None:
        """Echoes still tell that a SYNC was on the bus, but not when: they are stamped too late.

        It ended between the time of its frame after the hand-over and the quickest echo, so in the middle.
        """
        least, most = self._latency, max(self._latency, self._ways.low)
        self.basis = EchoBasis.NONE
        self.error_ns = ECHO_ERROR[EchoBasis.NONE] + (most - least) // 2
        self._latency = Duration((least + most) // 2)
        for mark in self.marks:
            if mark.on_bus_at is not None:
                mark.on_bus_at, mark.late_ns = Instant(mark.handed_at + self._latency), 0

    def heard(self, sequence: int, at: Instant) -> SyncMark:
        """A SYNC that another node makes in each period ended on the bus."""
        self.of_another = True
        if self.marks:
            periods = (at - self.last_on_bus + self._period // 2) // self._period
            self.missing += max(0, periods - 1)
            if self._echoes_late and periods > 0:
                self._ways.add(abs(at - self.last_on_bus - periods * self._period))
        mark = self._end_of_other(sequence, at)
        mark.late_ns = self._ways.high + self._ways.slack()
        return mark

    def stray(self, at: Instant) -> None:
        """A SYNC that nobody here expects ended on the bus."""
        self.surplus += 1
        self._end_of_other(SURPLUS, at)

    def came(self, at: Instant, handed_at: Instant = UNTOLD) -> None:
        """The echo of one of our SYNCs; ``handed_at``: of the one that was handed over then."""
        if handed_at == UNTOLD:
            self._place_by_order(at)
            return
        mark = next((mark for mark in self._pending if mark.handed_at == handed_at), None)
        if mark is None:
            self.stray(at)
            return
        self._pending.remove(mark)
        self._put_on_bus(mark, at)
        if self.marks[-1].handed_at > at:
            self._late_to_drives = self.counted + 1
        mark.late_to_drives = mark.number <= self._late_to_drives

    def not_heard(self, until: Instant) -> None:
        """Frames of before ``until`` may not have come: a SYNC without an echo may have been on the bus."""
        self.unheard_until = until
        for mark in self.marks:
            if mark.on_bus_at is None and mark.handed_at <= until:
                mark.sure = False

    def may_hide(self, mark: SyncMark, received_at: Instant) -> bool:
        """Return whether a reading that came then may answer a SYNC behind ``mark`` that was on the bus
        unheard."""
        if self.unheard_until < mark.handed_at:
            return False
        return any(
            later.number > mark.number and later.hidden and later.handed_at <= received_at
            for later in self.marks
        )

    def never_sent(self, handed_at: Instant) -> None:
        """The SYNC that was handed over then never went out."""
        for mark in reversed(self.marks):
            if mark.handed_at == handed_at:
                mark.unsent, mark.on_bus_at = True, None
                if mark in self._pending:
                    self._pending.remove(mark)
                return

    def _place_by_order(self, at: Instant) -> None:
        pending, instants = self._pending, self._instants
        before = self._handed_before(at)
        if before == 1 and not instants:
            self._put_on_bus(pending.pop(0), at)
        elif before > len(instants):
            # The newest are the likelier ones, as the older ones had been given up.
            instants.append(at)
            for mark, instant in zip(pending[before - len(instants) : before], instants, strict=True):
                mark.on_bus_at = instant
                if self.basis is not self.echoes:
                    mark.on_bus_at = Instant(mark.handed_at + self._latency)
            sure = len(instants) == before
            for mark in pending[:before]:
                mark.sure = sure
            if sure:
                del pending[:before]
                instants.clear()
            self._note_spacing(at)
        else:
            self.stray(at)

    def _handed_before(self, at: Instant) -> int:
        """How many of the pending had been handed over when an echo is from."""
        pending = self._pending
        latest = at + self._echo_error
        count = len(pending)
        while count and pending[count - 1].handed_at > latest:
            count -= 1
        return count

    def may_hand_over(self, now: Instant) -> bool:
        """Return whether no echo is awaited that may still come."""
        pending = self._pending
        if not pending or self._instants:
            return True
        return now - pending[-1].handed_at >= GIVEN_UP_AFTER_PERIODS * self._period

    def awaits_echo(self, at: Instant) -> bool:
        """Return whether the last SYNC was handed over by ``at``, and its echo is to be fetched yet.

        An adapter may bring a frame of another node before the echo of one that was on the bus first. Once
        the next SYNC has been handed over, its echo is not waited for.
        """
        last = self._pending[-1] if self._pending else None
        return last is not None and last.on_bus_at is None and self.last_on_bus < last.handed_at <= at

    @property
    def late_most(self) -> int:
        """By how much a SYNC may have ended before the instant that is known of it, ns."""
        if self.basis not in STAMPED_LATE:
            return 0
        ways = self._ways
        return ways.high + ways.slack() - (0 if self.of_another else ways.low)

    def heard_for(self, cycles: int, before_ns: int) -> bool:
        """Return whether the bus was heard of for so many cycles since :attr:`heard_ns` was ``before_ns``."""
        return self.heard_ns - before_ns >= cycles * self._period

    def end_of_first_after(self, sequence: int) -> Instant:
        """When the first SYNC of a cycle after ``sequence`` ended on the bus; NEVER if there is none yet."""
        at = NEVER
        for mark in reversed(self.marks):
            if mark.sequence > sequence and mark.on_bus_at is not None:
                at = mark.on_bus_at
            elif mark.sequence != SURPLUS:
                break
        return at

    def last_of(self, sequence: int) -> SyncMark | None:
        """The last SYNC of a cycle; None if it is not remembered."""
        return next((mark for mark in reversed(self.marks) if mark.sequence == sequence), None)

    def before_place(self, place: int) -> tuple[SyncMark, bool]:
        """The last SYNC up to ``place``, and whether it is that of the place itself, which was heard then."""
        mark = next((mark for mark in reversed(self.marks) if mark.place <= place), self.marks[0])
        return mark, mark.place == place

    def unheard_since(self, mark: SyncMark) -> int:
        """How many SYNCs of another node are missing behind ``mark``."""
        return self.missing - (mark.place - mark.number)

    def may_precede(self, at: Instant, mark: SyncMark) -> bool:
        """Return whether the last SYNC, behind ``mark``, may have ended by ``at``, as its echo was stamped
        late."""
        last = self.marks[-1]
        behind = last.number > mark.number and last.on_bus_at is not None
        return behind and (last.on_bus_at or 0) - last.late_ns <= at

    def may_lack(self, mark: SyncMark, at: Instant) -> bool:
        """Return whether another node's SYNC that was not heard lay nearer to ``at`` than ``mark``, the
        nearest."""
        assert mark.on_bus_at is not None
        if not self.of_another or 2 * abs(at - mark.on_bus_at) <= self._period:
            return False
        place = mark.number - self.marks[0].number + (1 if at > mark.on_bus_at else -1)
        return 0 <= place < len(self.marks) and abs(self.marks[place].place - mark.place) > 1

    def nearest(self, at: Instant) -> SyncMark | None:
        """The SYNC whose end on the bus is nearest to ``at``."""
        best: SyncMark | None = None
        least = -1
        for mark in reversed(self.marks):
            on_bus_at = mark.on_bus_at
            if on_bus_at is None:
                continue
            miss = abs(at - on_bus_at)
            if best is not None and miss > least:
                break
            best, least = mark, miss
        return best

    def beside(self, mark: SyncMark) -> list[SyncMark]:
        """The SYNCs before and after ``mark``, as far as it is known when they were on the bus."""
        beside: list[SyncMark] = []
        place, last = mark.number - self.marks[0].number, len(self.marks) - 1
        if place < last and self.marks[place + 1].on_bus_at is not None:
            beside.append(self.marks[place + 1])
        if place > 0 and self.marks[place - 1].on_bus_at is not None:
            beside.append(self.marks[place - 1])
        return beside

    def end_before(self, mark: SyncMark) -> Instant | None:
        """The end of the last SYNC on the bus before that of ``mark``; None if it is not remembered."""
        marks = self.marks
        for place in range(mark.number - marks[0].number - 1, -1, -1):
            on_bus_at = marks[place].on_bus_at
            if on_bus_at is not None:
                return on_bus_at
        return None

    def newest_before(self, at: Instant) -> SyncMark | None:
        """The last SYNC that had ended by ``at``."""
        for mark in reversed(self.marks):
            on_bus_at = mark.on_bus_at
            if on_bus_at is not None and on_bus_at <= at:
                return mark
        return None

    def _end_of_other(self, sequence: int, at: Instant) -> SyncMark:
        mark = self._remember(sequence, at)
        mark.on_bus_at = at
        self._note_spacing(at)
        return mark

    def _remember(self, sequence: int, at: Instant) -> SyncMark:
        self.counted += 1
        mark = SyncMark(self.counted, sequence, at)
        mark.place += self.missing
        self.marks.append(mark)
        if len(self.marks) > REMEMBERED:
            self.marks.pop(0)
        return mark

    def _put_on_bus(self, mark: SyncMark, at: Instant) -> None:
        if self.basis is not self.echoes:
            if at - mark.handed_at > self._ways.high + self._ways.slack():
                mark.sure = False  # it may have waited in front of the bus
            at = Instant(mark.handed_at + self._latency)
        elif self._echoes_late:
            way = at - mark.handed_at
            self._ways.add(way)
            mark.late_ns = way - self._ways.low + self._ways.slack()
        mark.on_bus_at = at
        self._note_spacing(at)

    def _note_spacing(self, at: Instant) -> None:
        spacing = at - self.last_on_bus
        if spacing < self._period // 2:
            self.crowded += 1
        self.heard_ns += max(0, min(spacing, GIVEN_UP_AFTER_PERIODS * self._period))
        self.last_on_bus = at
