"""A command that was sent, and what tellings have shown of it so far."""

from typing import Final

from mypy_extensions import mypyc_attr

from servobench.drivers.exchange import SentCommand
from servobench.drivers.timebase import Instant
from servobench.hil.loop.samples import CommandFate

PASSES_WATCHED: Final = 32
"""Commands whose least number of passes stands for the next ones."""
CHANGES_WAIT: Final = 32
"""Commands in the past of which a stamped change may still tell: where delays spread it waits for twelve more
readings, and some of those are lost."""
MANY: Final = 1 << 30
"""More passes than a command can have."""


@mypyc_attr(acyclic=True, free_list_len=1)
class FollowedCommand:
    """A command and what is known of its effect; :mod:`servobench.hil.loop.command_meter` sets what it
    learns."""

    __slots__ = (
        "acts_by",
        "counted",
        "excluded",
        "fate",
        "heard_ns",
        "judged",
        "late_most",
        "not_before",
        "not_before_usual",
        "passed",
        "passes",
        "possible",
        "raw",
        "reached_by",
        "replaced",
        "sent",
        "shows",
        "stamped_from",
    )

    def __init__(self, sent: SentCommand, shows: bool, late_most: int, heard_ns: int) -> None:
        """``shows``: its own echo tells when it is on the bus; ``late_most``: how much later an echo may be
        stamped, ns. ``heard_ns``: for how long the bus had been heard of."""
        self.sent = sent
        self.raw = sent.raw
        self.shows = shows
        self.late_most = late_most
        self.heard_ns = heard_ns
        self.fate: CommandFate | None = None
        """Acting, or None."""
        self.not_before: Instant | None = None
        """The latest instant at which an older one was followed."""
        self.not_before_usual: Instant | None = None
        """The same, of the SYNCs by which commands are passed at the least."""
        self.passes = 0
        """SYNCs from its arrival to the last at which an older one was followed, that one included."""
        self.counted = False
        """True if it is known how many there were until it acted."""
        self.acts_by: Instant | None = None
        self.reached_by: Instant | None = None
        """By then the drive followed this one or a newer one."""
        self.possible = False
        """True if a telling may have been of it."""
        self.passed = False
        """True if it was there at a SYNC by which it should have acted, and an older one was followed."""
        self.replaced = False
        """True if a newer one is known to be followed."""
        self.judged = False
        """True if it is known if it is excluded."""
        self.excluded = False
        """True if it can have acted at no SYNC before it was replaced."""
        self.stamped_from: Instant | None = None
        """It did not act before, by the stamp with which the drive told the change to it; None without."""

    def was_there(self, at: Instant) -> bool:
        """Return whether it was on the bus by ``at``; where no echo tells, whether it had been handed
        over."""
        on_bus_at = self.sent.on_bus_at
        if on_bus_at is not None:
            return on_bus_at <= at
        return not (self.shows or self.sent.unsent) and self.sent.handed_at <= at

    def may_be_there(self, at: Instant) -> bool:
        """Return whether it may have been on the bus by ``at``: its echo may be stamped late, or
        another's."""
        sent = self.sent
        if sent.handed_at > at or sent.unsent or (self.shows and sent.on_bus_at is None):
            return False
        return self.first_there <= at

    @property
    def first_there(self) -> Instant:
        """It was not on the bus before."""
        sent = self.sent
        on_bus_at, maybe_at = sent.on_bus_at, sent.maybe_at
        if maybe_at is not None and (on_bus_at is None or maybe_at < on_bus_at):
            on_bus_at = maybe_at
        if on_bus_at is None or on_bus_at - self.late_most < sent.handed_at:
            return sent.handed_at
        return Instant(on_bus_at - self.late_most)

    def acts_after(self, fate: CommandFate, *, in_order: bool) -> Instant | None:
        """The latest instant known at which it did not act yet, of one with that fate.

        An older command that was followed later shows nothing by itself: it may have come twice.
        """
        if fate is not CommandFate.ACTING:
            return self.not_before if self.passed and self.replaced and not self.possible else None
        known = self._later(self.first_there, self.stamped_from)
        return self._later(known, self.not_before_usual) if in_order else known

    def _later(self, known: Instant, at: Instant | None) -> Instant:
        """Return the later of two instants at which it did not act yet; none is later than it acted."""
        if at is not None and known < at and (self.acts_by is None or at <= self.acts_by):
            return at
        return known

    def acted_before(self, at: Instant) -> bool:
        """Return whether it is known to have acted before ``at``."""
        return self.acts_by is not None and self.acts_by < at


class LeastPasses:
    """By how many SYNCs a command is passed at the least until it acts: as few as any of the last was."""

    def __init__(self) -> None:
        self.least = 0
        """0 before enough have acted."""
        self._next = MANY
        self._count = 0

    def add(self, passes: int) -> None:
        """So many passed the last one."""
        self.least, self._next = min(self.least, passes), min(self._next, passes)
        self._count += 1
        if self._count == PASSES_WATCHED:
            self.least, self._next, self._count = self._next, MANY, 0


class LastChange:
    """The last change of the demand, by the drive's own stamps."""

    def __init__(self) -> None:
        self._at = self._sent_at = Instant(0)

    def goes_back(self, at: Instant, oldest: FollowedCommand, newest: FollowedCommand) -> bool:
        """Take a change at ``at`` to a command from the ``oldest`` to the ``newest``; whether it goes back to
        one that was sent before the last: they came twice, or overtook one another."""
        later, goes_back = at > self._at, newest.sent.handed_at < self._sent_at
        if later:
            self._at, self._sent_at = at, oldest.sent.handed_at
        return later and goes_back
