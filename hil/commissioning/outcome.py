"""What came of a step of commissioning."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from drivers.errors import PeerFault


class StepFailed(PeerFault):
    """A step found what it must not find; it may be repeated, or skipped with a reason."""


class StepVerdict(Enum):
    """How a step ended."""

    DONE = "done"
    FAILED = "failed"
    SKIPPED = "skipped"
    """The user's word, with a reason."""
    LEFT_OUT = "left out"
    """The drive or the limits do not allow it."""
    NOT_DONE = "not done"
    """A dry run, or the end came first."""


@dataclass(slots=True)
class StepOutcome:
    """What a step found."""

    lines: list[str] = field(default_factory=list)
    """For the report, a sentence each."""
    figures: dict[str, Any] = field(default_factory=dict)
    """The same for programs."""
    faults: list[str] = field(default_factory=list)
    """What is wrong with the drive's settings, and what was done about it."""
    pictures: list[str] = field(default_factory=list)
    """File names of plots, relative to the report."""

    headline: str = ""
    """For the table at the top of the report; the first of ``lines`` if empty."""

    def say(self, line: str) -> None:
        """Add a sentence."""
        self.lines.append(line)


@dataclass(slots=True)
class StepRecord:
    """One step as the report tells it."""

    name: str
    title: str
    plan: str
    verdict: StepVerdict
    reason: str = ""
    outcome: StepOutcome = field(default_factory=StepOutcome)
    attempts: int = 1
