"""The errors of the bench: one root, and two branches that must not be confused; text safe for a terminal.

``BadInput``: we, or the user, asked for something wrong (exit status 2).
``PeerFault``: the bus or the drive did something wrong, or nothing (exit status 3).

A failure carries its evidence, and its message says what to do next. :func:`printable` escapes what
foreign text would do to the terminal that shows it.
"""

import unicodedata
from dataclasses import dataclass
from typing import Any

from servobench.drivers.timebase import Instant

PART_SHOWN_MAX = 400
"""Characters of each part of a message: a file may hold keys and names as long as itself."""


class BenchError(Exception):
    """Root of every error that a user may see without a traceback."""

    exit_status = 3


@dataclass(eq=False)
class BadInput(BenchError):
    """A value in a file or on the command line that cannot be used."""

    source: str
    """The file, or the command-line option, that holds the value."""
    key: str
    """Dotted path of the key, e.g. ``drive.axis1.node``; empty if the whole file is meant."""
    value: Any
    """The value found; ``MISSING``, or None of an option, if there was none."""
    expected: str
    """The accepted values."""
    remedy: str = ""
    """The next step for the user, if ``expected`` does not already say it."""

    exit_status = 2

    def __str__(self) -> str:
        key, value = _shortened(self.key), _shortened(repr(self.value))
        place = f"{self.source}: {key}" if key else self.source
        found = "missing" if self.value is MISSING or self.value is None else f"found {value}"
        text = f"{place}: {found}, expected {_shortened(self.expected)}"
        return printable(f"{text}; {_shortened(self.remedy)}" if self.remedy else text)


def _shortened(text: str) -> str:
    return text if len(text) <= PART_SHOWN_MAX else f"{text[:PART_SHOWN_MAX]}..."


class Missing:
    """Marks an absent value in a :class:`BadInput`."""

    def __repr__(self) -> str:
        return "missing"


MISSING = Missing()


@dataclass(eq=False)
class PeerFault(BenchError):
    """The bus or a device on it failed; ``evidence`` is what was observed."""

    summary: str
    evidence: str = ""
    remedy: str = ""
    seen_at: Instant | None = None
    """When the failure showed, by the stamp of the frame that reported it; None: when this was raised."""

    def __str__(self) -> str:
        return "; ".join(part for part in (self.summary, self.evidence, self.remedy) if part)


class BusDown(PeerFault):
    """The CAN interface cannot be opened, or went away."""


class NoAnswer(PeerFault):
    """A node did not answer within its deadline."""


class AnswersTwice(PeerFault):
    """A node sent more answers than requested: most likely two nodes share its id."""


class DriveInFault(PeerFault):
    """A drive reports a fault, or fell out of the state that it was to be in."""


class PowerLost(PeerFault):
    """The power stage of an enabled drive has lost its voltage: safe torque off, or no supply."""


@dataclass(eq=False)
class TransferAborted(PeerFault):
    """A device refused an SDO transfer; ``evidence`` holds the abort code and its text."""

    code: int = 0
    """The abort code (CiA 301 table 22)."""


class LimitExceeded(PeerFault):
    """A host safety limit was crossed and the run was stopped."""


_ACTING = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
"""Unicode categories: control, format (direction of writing among them), surrogate, private, unassigned, and
the separators of lines and paragraphs."""


def printable(text: str) -> str:
    """Return ``text`` with every character that a terminal would obey, or could not show, as ``\x1b``."""
    if text.isprintable():
        return text
    return "".join(_escaped(sign) if unicodedata.category(sign) in _ACTING else sign for sign in text)


def _escaped(sign: str) -> str:
    return sign.encode("unicode_escape").decode("ascii")
