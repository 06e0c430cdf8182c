"""A command that was sent, and what tellings have shown of it so far."""

from drivers.exchange import SentCommand
from drivers.timebase import Instant
from hil.loop.samples import CommandFate


class FollowedCommand:
    """A command and what is known of its effect; :mod:`hil.loop.command_meter` sets what it learns."""

    __slots__ = (
        "acts_by",
        "excluded",
        "fate",
        "heard_ns",
        "judged",
        "not_before",
        "passed",
        "possible",
        "raw",
        "reached_by",
        "replaced",
        "sent",
        "shows",
        "stamped",
    )

    def __init__(self, sent: SentCommand, shows: bool, heard_ns: int) -> None:
        """``shows``: its own echo tells when it is on the bus. ``heard_ns``: for how long the bus had been
        heard of."""
        self.sent = sent
        self.raw = sent.raw
        self.shows = shows
        self.heard_ns = heard_ns
        self.fate: CommandFate | None = None
        """Acting, or None."""
        self.not_before: Instant | None = None
        """The latest instant at which an older one was followed."""
        self.acts_by: Instant | None = None
        self.reached_by: Instant | None = None
        """By then the drive followed this one or a newer one."""
        self.possible = False
        """Whether a telling may have been of it."""
        self.passed = False
        """Whether it was there at a SYNC by which it should have acted, and an older one was followed."""
        self.replaced = False
        """Whether a newer one is known to be followed."""
        self.judged = False
        """Whether it is known if it is excluded."""
        self.excluded = False
        """Whether it can have acted at no SYNC before it was replaced."""
        self.stamped = False
        """Whether the drive has stamped the change to it."""

    def was_there(self, at: Instant) -> bool:
        """Whether it was on the bus by ``at``; where no echo tells, whether it had been handed over."""
        on_bus_at = self.sent.on_bus_at
        if on_bus_at is not None:
            return on_bus_at <= at
        return not (self.shows or self.sent.unsent) and self.sent.handed_at <= at

    def acted_before(self, at: Instant) -> bool:
        """Whether it is known to have acted before ``at``."""
        return self.acts_by is not None and self.acts_by < at
