"""What became of each command of an axis, from its echo and from the torque demand that the drive tells.

    SYNC ends           s1              s2              s3
    commands        1       2               3                handed over
    0x6074             1           1              3          told with the reading of that SYNC
    fate                2: lost, as the drive never followed it; 3: acts after s2, by s3

0x6074 tells which command is in force when a SYNC ends; told at every change, with a stamp, it tells when the
command began to act. A command that equals the one before or after it cannot be told from that; and one that
was replaced before the next telling is not seen at all: both are *not identifiable*, and counted apart from
those that were lost.

Where an echo tells of which frame it is, a command without one was not on the bus: it cannot act, and is lost
once the bus has been heard of for longer than a frame may take.
"""

from typing import Final

from drivers.exchange import SentCommand
from drivers.timebase import Duration, Instant
from drivers.wire.frame_port import EchoBasis
from hil.loop.delay import UNHEARD_MAX
from hil.loop.samples import CommandFate, Sending
from hil.loop.syncs import SyncLog

FOLLOWED_MAX: Final = 256
"""Commands followed at a time: more than there are cycles for which a row waits, the longest horizon and
:data:`UNHEARD_MAX` together."""
ECHO_CYCLES: Final = 2
"""A command's echo is there within so many cycles, or it is of no use to wait for it."""


class _Followed:
    """A command and what is known of its effect."""

    def __init__(self, sent: SentCommand, shows: bool, heard_ns: int) -> None:
        """``shows``: its own echo tells when it is on the bus. ``heard_ns``: for how long the bus had been
        heard of."""
        self.sent = sent
        self.shows = shows
        self.heard_ns = heard_ns
        self.fate: CommandFate | None = None
        """None while it is open."""
        self.acts_after: Instant | None = None
        """The latest SYNC at which it was there, and not followed yet."""
        self.acts_by: Instant | None = None

    def was_there(self, at: Instant) -> bool:
        """Whether it was on the bus by ``at``; where no echo tells, whether it had been handed over."""
        on_bus_at = self.sent.on_bus_at
        if on_bus_at is not None:
            return on_bus_at <= at
        return not self.shows and self.sent.handed_at <= at


class CommandMeter:
    """Follows the commands of one axis."""

    def __init__(
        self,
        horizon: int,
        syncs: SyncLog,
        settles: Duration = Duration(0),  # noqa: B008 - an int
    ) -> None:
        """``horizon``: cycles after which a command is settled with what is known by then. ``syncs``: of the
        axis's segment; it tells what was heard of the bus. ``settles``: a command that came less than this
        before a SYNC need not show at it: a period where set-points act at SYNCs, as the drive tells before
        it takes them."""
        self.unexplained = 0
        """Read-backs that equal no command on its way: the drive limits or shapes its set-point."""
        self._horizon = horizon
        self._syncs = syncs
        self._shows = syncs.echoes is EchoBasis.BUS
        self._settles = settles
        self._followed: list[_Followed] = []
        """In the order of sending, from the oldest whose fate was not asked for."""
        self._acting: _Followed | None = None
        self._told_raw: int | None = None
        self._telling = False

    def sent(self, command: SentCommand) -> None:
        """A command has been handed over."""
        followed = self._followed
        followed.append(_Followed(command, self._shows, self._syncs.heard_ns))
        if len(followed) > FOLLOWED_MAX:
            del followed[0]

    def told(self, demand_raw: int, sync_at: Instant) -> None:
        """The drive followed ``demand_raw`` when the SYNC of ``sync_at`` ended; in order of SYNCs."""
        self._telling = True
        before, self._told_raw = self._told_raw, demand_raw
        if self._follows_in_order(demand_raw, sync_at):
            return
        candidates = self._candidates(sync_at)
        if not candidates:
            return
        equal = [one for one in candidates if one.sent.raw == demand_raw]
        self._note_not_yet(candidates, equal[-1] if equal else self._acting, sync_at)
        if not equal:
            if self._acting is None or self._acting.sent.raw != demand_raw:
                self.unexplained += 1
            return
        acting = equal[-1]
        if acting is self._acting:
            return
        if acting.fate is not CommandFate.ACTING:
            last_raw = before if self._acting is None else self._acting.sent.raw
            if len(equal) > 1 or last_raw is None or last_raw == demand_raw:
                acting.fate = CommandFate.NOT_IDENTIFIABLE
            else:
                self._note_acting(acting, sync_at)
        self._replace(acting, candidates)

    def changed(self, demand_raw: int, at: Instant, error: Duration) -> None:
        """The drive began to follow ``demand_raw`` at ``at``, which is right within ``error``."""
        self._telling = True
        candidates = self._candidates(Instant(at + error))
        equal = [one for one in candidates if one.sent.raw == demand_raw]
        if len(equal) == 1 and equal[0] is not self._acting:
            command = equal[0]
            command.fate = CommandFate.ACTING
            command.acts_after, command.acts_by = Instant(at - error), Instant(at + error)
            self._replace(command, candidates)

    def _note_not_yet(self, candidates: list[_Followed], acting: _Followed | None, sync_at: Instant) -> None:
        """Commands newer than the one in force did not act at this SYNC, though they should have shown."""
        for newer in reversed(candidates):
            if newer is acting:
                return
            if newer.was_there(Instant(sync_at - self._settles)):
                newer.acts_after = sync_at

    def _follows_in_order(self, demand_raw: int, sync_at: Instant) -> bool:
        """The usual case, without a detour: the newest command follows the one that acted, and acts now."""
        followed, acting = self._followed, self._acting
        last = len(followed) - 1
        while last >= 0 and not followed[last].was_there(sync_at):
            last -= 1
        if last < 1 or acting is None or followed[last - 1] is not acting:
            return False
        newest = followed[last]
        if newest.sent.raw != demand_raw or acting.sent.raw == demand_raw or newest.fate is not None:
            return False
        self._note_acting(newest, sync_at)
        self._acting = newest
        return True

    def _replace(self, acting: _Followed, candidates: list[_Followed]) -> None:
        """The drive follows ``acting`` now; older ones that it was seen not to follow were lost."""
        for older in candidates:
            if older is acting:
                break
            if older.fate is None:
                seen_off = older.acts_after is not None and older.sent.raw != acting.sent.raw
                older.fate = CommandFate.LOST if seen_off else CommandFate.NOT_IDENTIFIABLE
        self._acting = acting

    def outcome(self, sequence: int, now: int) -> Sending | None:
        """What became of the command of cycle ``sequence``, seen from cycle ``now``; None while it is open.

        To be asked in order of the cycles that sent one; what was told of is forgotten.
        """
        followed = self._followed
        while followed and followed[0].sent.sequence < sequence:
            del followed[0]
        if not followed or followed[0].sent.sequence != sequence:
            return None
        first = followed[0]
        fate = first.fate
        if fate is None:
            fate = self._outcome_unseen(first, now - sequence)
            if fate is None:
                return None
        del followed[0]
        sent = first.sent
        return Sending(sent.raw, sent.handed_at, sent.on_bus_at, fate, first.acts_after, first.acts_by)

    def _outcome_unseen(self, command: _Followed, age: int) -> CommandFate | None:
        """Of a command that the drive was seen neither to follow nor to pass over, after ``age`` cycles."""
        missing = command.shows and command.sent.on_bus_at is None
        if age < (self._horizon if self._telling or missing else ECHO_CYCLES):
            return None
        if missing:
            if self._syncs.heard_for(self._horizon, command.heard_ns):
                return CommandFate.LOST
            if age < UNHEARD_MAX:
                return None
        return CommandFate.NOT_IDENTIFIABLE if self._telling else CommandFate.NOT_MEASURED

    def _candidates(self, sync_at: Instant) -> list[_Followed]:
        """The commands that may act at ``sync_at`` in place of the one that acted before, oldest first."""
        start = 0
        followed = self._followed
        for place in range(len(followed) - 1, -1, -1):
            if followed[place] is self._acting:
                start = place
                break
        return [one for one in followed[start:] if one.was_there(sync_at)]

    def _note_acting(self, command: _Followed, sync_at: Instant) -> None:
        command.fate = CommandFate.ACTING
        command.acts_by = sync_at
        on_bus_at = command.sent.on_bus_at
        there = command.sent.handed_at if on_bus_at is None else on_bus_at
        if command.acts_after is None or command.acts_after < there:
            command.acts_after = there
