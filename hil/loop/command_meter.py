"""Fate of each command of an axis, from its echo and from the torque demand that the drive tells.

    SYNC ends           s1              s2              s3
    commands        1       2               3                on the bus
    0x6074             1           1              3          followed at that SYNC
    fate                2: not identifiable, passed over; 3: acting after s2, by s3

A telling says that the drive followed a command at some instant *from* one *to* another: an exact one at the
end of a SYNC, one whose SYNC is not known over a longer time. Commands arrive in the order in which they were
sent, each once, until a telling shows that they do not. From that alone:

- *acting*: a telling that only this command explains. It began to act after it could be there first, and
  after as many SYNCs as pass each command; it acted by the end of the telling. An older one that is told
  later than that does not bound it: a network that brings commands twice makes the same tellings.
- *lost*: it never was on the bus, as no echo came and none was lost; or the drive takes set-points at
  SYNCs, and from its arrival to the command that replaced it each SYNC has a telling, none explained by it.
- *not identifiable*: all others. It equals a neighbour, or the drive was not asked in time. One that was
  there at a SYNC and not followed then was *passed over*: lost, or followed between two SYNCs only, which no
  telling excludes.
"""

from typing import Final

from servobench.drivers.exchange import SentCommand
from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.delay import UNHEARD_MAX
from servobench.hil.loop.followed_command import CHANGES_WAIT, FollowedCommand, LastChange, LeastPasses
from servobench.hil.loop.samples import CommandFate, Sending
from servobench.hil.loop.syncs import ECHO_ERROR, LATE_WITHOUT_BOUND, STAMPED_LATE, SyncLog, SyncMark

FOLLOWED_MAX: Final = 256
"""Commands followed at a time: more than there are cycles for which a row waits, the longest horizon and
:data:`UNHEARD_MAX` together."""
NEVER_YET: Final = Instant(-(1 << 62))
ECHO_CYCLES: Final = 2
"""A command's echo is there within so many cycles, or it is of no use to wait for it."""
REPLACED_CYCLES: Final = 5
"""A command that was replaced is open for so many cycles. Its successor is sent in the next, taken at the
SYNC after that and told at the one after that, which is taken in with the reading of the next; a stamped
change is there earlier."""


class CommandMeter:
    """Follows the commands of one axis."""

    def __init__(self, horizon: int, syncs: SyncLog, acts_at_syncs: bool = False) -> None:
        """``horizon``: cycles after which a command is settled with what is known by then. ``syncs``: of the
        axis's segment; it tells what was heard of the bus. ``acts_at_syncs``: set-points are taken at the
        first SYNC after they came, and the drive may tell before it takes them."""
        self.unexplained = 0
        """Tellings that equal no command on its way: the drive limits or shapes its set-point."""
        self.out_of_order = 0
        """Tellings that equal a command older than one that had been followed by then."""
        self.patient = False
        """True if a telling may come later than a newer one: one that was replaced is open to the horizon."""
        self._horizon = horizon
        self._window = horizon + REPLACED_CYCLES
        self._syncs = syncs
        self._shows = syncs.echoes is EchoBasis.BUS
        self._echo_error = ECHO_ERROR[syncs.echoes]
        self._late_most = LATE_WITHOUT_BOUND if syncs.echoes in STAMPED_LATE else self._echo_error
        self._at_syncs = acts_at_syncs
        self._followed: list[FollowedCommand] = []
        """In the order of sending."""
        self._asked = 0
        """So many of them have been asked for."""
        self._past = 0
        """So many of them are older than any that may still be followed."""
        self._before_raw: int | None = None
        """Demand that may be followed of those in the past, or before the first command; None: not known."""
        self._telling = False
        self._stamping = False
        """True if changes are told with a stamp."""
        self._unordered = False
        """True if commands have overtaken one another on the way, by the drive's own stamps."""
        self._last_told: tuple[Instant, SyncMark | None] = (NEVER_YET, None)
        self._exact: SyncMark | None = None
        """The last SYNC with an exact telling."""
        self._seen_since = Instant(0)
        """From the SYNC that ended then every SYNC up to ``_exact`` has an exact telling."""
        self._steady_raw: int | None = None
        """What the last telling was of, if all from the one in force to the newest there have it, or None."""
        self._steady_from = self._steady_to = 0
        """Places of those two; the first is in the past where what was before it is followed, or it."""
        self._passes, self._last_change = LeastPasses(), LastChange()

    def sent(self, command: SentCommand) -> None:
        """A command has been handed over."""
        followed = self._followed
        followed.append(FollowedCommand(command, self._shows, self._late_most, self._syncs.heard_ns))
        if len(followed) - self._past > self._window:
            leaving, told = followed[self._past], self._last_told
            if leaving.possible:
                self._before_raw = leaving.raw
            elif not (leaving.sent.unsent or leaving.was_there(self._settled_by(told[0], told[1]))):
                self._before_raw = None  # no telling has shown yet whether it is followed
            self._past += 1
        while self._past > CHANGES_WAIT and (self._asked or len(followed) > FOLLOWED_MAX):
            followed.pop(0)
            self._past -= 1
            self._steady_from -= 1
            self._steady_to -= 1
            self._asked = max(0, self._asked - 1)

    def told(self, demand_raw: int, since: Instant, until: Instant, sync: SyncMark | None = None) -> None:
        """The drive followed ``demand_raw`` at an instant from ``since`` to ``until``; ``sync``: the SYNC
        that it is of, None if that is not known."""
        self._telling = True
        self._last_told = since, sync
        if sync is not None and self._at_syncs:
            self._note_sync(sync)
        if demand_raw == self._steady_raw and self._goes_on(demand_raw, since, until, sync):
            return
        if self._follows_in_order(demand_raw, since, until, sync):
            return
        self._steady_raw = None
        equal = self._explaining(demand_raw, since, until)
        if not equal:
            self._exact = None
            return
        self._note_not_yet(equal[-1], since, sync)
        self._note_possible(equal)
        self._note_steady(equal, until)
        if equal[0] < 0:
            for older in self._followed[: self._past]:
                older.possible = older.possible or older.raw == demand_raw
            return
        if len(equal) == 1:
            self._note_acting(self._followed[equal[0]], until, sync)
        self._reach(equal[0], until)
        self._exclude(equal[0], sync)

    def changed(self, demand_raw: int, at: Instant, error: Duration) -> None:
        """The drive began to follow ``demand_raw`` at ``at``, which is right within ``error``. Where commands
        come twice, or newer ones were there and frames overtake, it may have been before, and untold."""
        self._telling = True
        self._steady_raw = None
        since, until, followed = Instant(at - error), Instant(at + error), self._followed
        in_force = self._in_force(since, 0)
        equal = [
            place
            for place in range(max(in_force, 0), len(followed))
            if followed[place].raw == demand_raw
            and followed[place].may_be_there(until)
            and (self._unordered or not followed[place].acted_before(since))
        ]
        if not equal:
            self._unordered = self._unordered or self._equals_older(demand_raw, in_force)
            return
        self._note_possible(equal)
        self._unordered |= self._last_change.goes_back(at, followed[equal[0]], followed[equal[-1]])
        if len(equal) == 1:
            command = followed[equal[0]]
            self._note_acting(command, until, None)
            if not (self._unordered or (self.patient and self._any_there(equal[0] + 1, since))):
                command.stamped_from = min(since, command.stamped_from or since)
            self._stamping = True
            self._reach(equal[0], until)

    def _goes_on(self, demand_raw: int, since: Instant, until: Instant, sync: SyncMark | None) -> bool:
        """A demand that does not change, without a look at all the commands that have it."""
        if self._unordered:
            return False
        followed, first = self._followed, self._steady_from
        if first < self._past:
            if self._before_raw != demand_raw:
                return False
        else:
            reached_by = followed[first].reached_by
            if reached_by is None or reached_by > since:
                return False
        fresh = place = max(self._steady_to + 1, self._past)
        while (
            place < len(followed)
            and followed[place].raw == demand_raw
            and followed[place].may_be_there(until)
        ):
            place += 1
        if self._any_there(place, until):
            return False
        for new in range(fresh, place):
            followed[new].possible = True
        self._steady_to = max(self._steady_to, place - 1)
        if first >= self._past:
            if first == self._steady_to:
                self._note_acting(followed[first], until, sync)
            self._exclude(first, sync)
        return True

    def _note_steady(self, equal: list[int], until: Instant) -> None:
        """Note that one of the commands at ``equal`` is followed."""
        oldest, newest = equal[0], equal[-1]
        first = max(oldest, self._past)
        if len(equal) != newest - first + (2 if oldest < 0 else 1):
            return
        if newest >= 0 and not self._any_there(newest + 1, until):
            self._steady_raw = self._followed[newest].raw
            self._steady_from, self._steady_to = oldest, newest

    def _any_there(self, place: int, at: Instant) -> bool:
        """Return whether any command from ``place`` on may have been there by ``at``."""
        while place < len(self._followed) and not self._followed[place].may_be_there(at):
            place += 1
        return place < len(self._followed)

    def _follows_in_order(
        self, demand_raw: int, since: Instant, until: Instant, sync: SyncMark | None
    ) -> bool:
        """The usual case, without a detour: the newest command follows one that acted before, and acts.

        Where set-points are taken at SYNCs the drive tells before it takes: then it is the newest but one.
        """
        followed = self._followed
        last = len(followed) - 1
        while last >= 0 and not followed[last].may_be_there(until):
            last -= 1
        place = last
        if self._at_syncs and last > 0 and followed[last].raw != demand_raw and not followed[last].possible:
            place -= 1
        if place <= self._past or self._unordered:
            return False
        newest, before = followed[place], followed[place - 1]
        if newest.raw != demand_raw or before.raw == demand_raw or newest.possible:
            return False
        if before.reached_by is None or before.reached_by > since or not newest.may_be_there(until):
            return False
        if place < last:
            self._note_not_yet(place, since, sync)
        newest.possible = True
        self._note_acting(newest, until, sync)
        self._reach(place, until)
        self._exclude(place, sync)
        self._steady_raw = demand_raw if place == last else None
        self._steady_from = self._steady_to = place
        return True

    def _in_force(self, at: Instant, oldest: int) -> int:
        """Place of the newest command, from the ``oldest`` on, of which it is known that it, or a newer one,
        was followed by ``at``; -1: of none."""
        if self._unordered:
            return -1
        followed = self._followed
        for place in range(len(followed) - 1, oldest - 1, -1):
            reached_by = followed[place].reached_by
            if reached_by is not None and reached_by <= at:
                return place
        return -1

    def _explaining(self, demand_raw: int, since: Instant, until: Instant) -> list[int]:
        """Places of the commands that may have been followed, the oldest first, -1 for what was before them;
        empty if nothing explains the demand."""
        followed = self._followed
        in_force = self._in_force(since, self._past)
        equal = [
            place
            for place in range(max(in_force, self._past), len(followed))
            if followed[place].raw == demand_raw and followed[place].may_be_there(until)
        ]
        if in_force < 0 and self._before_raw in (None, demand_raw):
            self._before_raw = demand_raw
            equal.insert(0, -1)
        if equal:
            return equal
        if self._equals_older(demand_raw, in_force):
            self.out_of_order += 1
        else:
            self.unexplained += 1
        return equal

    def _equals_older(self, demand_raw: int, place: int) -> bool:
        return any(older.raw == demand_raw for older in self._followed[: max(0, place)])

    def _note_not_yet(self, place: int, since: Instant, sync: SyncMark | None) -> None:
        """No command newer than the one at ``place`` was followed at ``since``."""
        followed = self._followed
        settled = self._settled_by(since, sync)
        for newer in range(max(place + 1, self._past), len(followed)):
            command = followed[newer]
            if not command.was_there(since):
                continue
            if command.not_before is None or command.not_before < since:
                command.not_before = since
            if command.was_there(settled):
                command.passed = True
            if sync is not None:
                command.passes = self._passes_until(command, sync)
                if command.passes <= self._passes.least:
                    command.not_before_usual = since

    def _settled_by(self, since: Instant, sync: SyncMark | None) -> Instant:
        """Return when one is passed over that was there and is not followed in a telling of these."""
        if self._at_syncs:
            previous = None if sync is None else self._syncs.end_before(sync)
            return NEVER_YET if previous is None else Instant(previous - self._echo_error)
        return Instant(since - self._echo_error)

    def _passes_until(self, command: FollowedCommand, sync: SyncMark) -> int:
        """SYNCs from the first one at which a command was there to ``sync``, that one included."""
        last = self._syncs.newest_before(command.first_there)
        return sync.place - (0 if last is None else last.place)

    def _note_possible(self, places: list[int]) -> None:
        for place in places:
            if place >= 0:
                self._followed[place].possible = True

    def _note_acting(self, command: FollowedCommand, until: Instant, sync: SyncMark | None) -> None:
        command.fate = CommandFate.ACTING
        if sync is not None and not command.counted:
            command.counted = True
            if self._passes_until(command, sync) == command.passes + 1:
                self._passes.add(command.passes)
        if command.acts_by is None or until < command.acts_by:
            command.acts_by = until

    def _reach(self, place: int, until: Instant) -> None:
        """The command at ``place``, or a newer one, was followed by ``until``."""
        followed = self._followed
        reached = followed[place]
        if reached.reached_by is None or until < reached.reached_by:
            reached.reached_by = until
        for older in range(place - 1, -1, -1):
            if followed[older].replaced:
                return
            followed[older].replaced = True

    def _exclude(self, place: int, sync: SyncMark | None) -> None:
        """The command at ``place``, or a newer one, was followed at ``sync``: which ones before it can have
        acted at no SYNC is known now."""
        if sync is None or not self._at_syncs:
            return
        followed = self._followed
        for older in range(place - 1, -1, -1):
            command = followed[older]
            if command.judged:
                return
            command.judged = True
            first = command.first_there
            command.excluded = not command.possible and first > self._seen_since + self._echo_error

    def _note_sync(self, sync: SyncMark) -> None:
        """The telling of ``sync`` is known."""
        if sync is self._exact:
            return
        marks = self._syncs.marks
        place = sync.number - marks[0].number - 1
        while place >= 0 and marks[place].on_bus_at is None and self._shows and marks[place].sure:
            place -= 1  # it has no echo, so it never was on the bus
        before = self._exact
        unheard = before is not None and sync.place - before.place > sync.number - before.number
        if place < 0 or marks[place] is not before or unheard:
            self._seen_since = sync.handed_at if sync.on_bus_at is None else sync.on_bus_at
        self._exact = sync

    def outcome(self, sequence: int, now: int) -> Sending | None:
        """Return the fate of the command of cycle ``sequence``, seen from ``now``; None while it is open.

        To be asked in order of the cycles that sent one; what was told of is forgotten.
        """
        followed = self._followed
        while self._asked < len(followed) and followed[self._asked].sent.sequence < sequence:
            self._asked += 1
        if self._asked == len(followed) or followed[self._asked].sent.sequence != sequence:
            return None
        command = followed[self._asked]
        fate = CommandFate.NOT_SENT if command.sent.unsent else command.fate
        if fate is not None:
            waits = self._stamping and self.patient and command.stamped_from is None
            if waits and now - sequence < self._horizon:
                return None
        else:
            fate = self._outcome_unseen(command, now - sequence)
            if fate is None:
                return None
        self._asked += 1
        sent = command.sent
        return Sending(
            sent.raw, sent.handed_at, sent.on_bus_at, fate,
            command.acts_after(fate, in_order=not self._unordered), command.acts_by,
        )  # fmt: skip

    def _outcome_unseen(self, command: FollowedCommand, age: int) -> CommandFate | None:
        """Return the fate of a command that no telling was certainly of, after ``age`` cycles."""
        no_echo = command.shows and command.sent.on_bus_at is None
        missing = no_echo and command.sent.handed_at > self._syncs.unheard_until
        if command.replaced and not missing:
            if age < (self._horizon if command.excluded or self.patient else REPLACED_CYCLES):
                return None
            sure = command.excluded and not (no_echo or command.possible or self.patient or self._unordered)
            return CommandFate.LOST if sure else CommandFate.NOT_IDENTIFIABLE
        if age < (self._horizon if self._telling or missing else ECHO_CYCLES):
            return None
        if missing:
            if self._syncs.heard_for(self._horizon, command.heard_ns):
                return CommandFate.LOST
            if age < UNHEARD_MAX:
                return None
        return CommandFate.NOT_IDENTIFIABLE if self._telling else CommandFate.NOT_MEASURED
