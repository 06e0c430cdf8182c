"""Log format of one fault kind, and the replacements of a struck frame."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

NONE: Final = -1
"""A number that an entry does without: the bit of a frame that was lost, the recovery that never comes."""
UNDAMAGED: Final = -1
Copies = tuple[tuple[int, int], ...]
"""Replacements of a frame: for each copy the inverted bit of its data (UNDAMAGED: none), and its delay, ns,
after the frame's own turn."""


@dataclass(frozen=True, slots=True)
class LogNumber:
    """One number of an entry, as it stands in a line of faults.jsonl."""

    name: str
    least: int = 0
    optional: bool = False
    """May be NONE. Only for the first number; the others are then left out with it."""
    words: tuple[bool | str, ...] = ()
    """Words written for 0, 1, 2 ... instead."""
    usual: int | None = None
    """The value that is left out."""
    unsaid: int | None = None
    """Value in logs that lack it, though it is always written."""


@dataclass(frozen=True, slots=True)
class LogKind:
    """Entries of one kind."""

    name: str
    numbers: tuple[LogNumber, ...] = ()
    """At most three."""
    at: Literal["link", "node", "host"] = "link"
    tells: Literal["frame", "count", "nothing"] = "frame"
    """Which it was beside: the n-th frame of an identifier, the n-th of all, or nothing."""
    copies: Callable[[int], Copies] | None = None
    """Replacements of a struck frame by the entry's first number; None: it is lost."""
    in_order: bool = True
    """The frames behind it wait for what goes on."""
    alters: bool = False
    """The frame goes on with other values, whatever else befalls it (:mod:`.mangler`)."""
    of: Callable[[int, int], str] | None = None
    """Tells what was struck by the first two numbers; strikes of each count for themselves."""
    says: Callable[[int, int], str] | None = None
    """Tells by the first two numbers of something that is no strike."""
    since_power_on: bool = False
    """It counts its times from the drive's power-on, not from the plan's time zero."""

    @property
    def in_windows(self) -> bool:
        """So many may strike in a row that a reader is told from when to when."""
        return self.says is None and (self.tells == "frame" or self.at == "host")


LATER: Final = LogNumber("delay_ns", unsaid=0)
"""For how long a fault of the same frame delays it."""


def node_event(name: str, *numbers: LogNumber, since_power_on: bool = False) -> LogKind:
    """Entries of something that befalls a node now and then."""
    return LogKind(name, numbers, "node", "nothing", since_power_on=since_power_on)
