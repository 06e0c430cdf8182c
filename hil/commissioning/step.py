"""A step of commissioning: what it will do, doing it, what came of it."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, ClassVar

from drivers.errors import PeerFault

if TYPE_CHECKING:
    from hil.commissioning.session import Session


class StepFailed(PeerFault):
    """A step found what it must not find; it may be repeated, or skipped with a reason."""


class Verdict(Enum):
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
class Outcome:
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
    verdict: Verdict
    reason: str = ""
    outcome: Outcome = field(default_factory=Outcome)
    attempts: int = 1


class Step(ABC):
    """One step. The attributes say what it is; the methods are called in the order in which they stand."""

    name: ClassVar[str]
    title: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ()
    """Names of steps that must have been done."""
    writes: ClassVar[bool] = False
    """It changes objects of the drive."""
    moves: ClassVar[bool] = False
    """The shaft may turn."""
    essential: ClassVar[bool] = False
    """What follows is not safe without it: it cannot be skipped."""

    def left_out(self, session: "Session") -> str | None:  # noqa: ARG002 - most steps can always be done
        """Why this drive cannot have it, or None."""
        return None

    @abstractmethod
    def plan(self, session: "Session", /) -> str:
        """What it will do, before it is asked for."""

    @abstractmethod
    def run(self, session: "Session") -> Outcome:
        """Do it and check it. Raises StepFailed, or another PeerFault of bus or drive."""
