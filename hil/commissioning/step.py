"""A step of commissioning: what it will do, and doing it."""

from abc import ABC, abstractmethod
from typing import ClassVar

from hil.commissioning.outcome import Outcome
from hil.commissioning.session import Session


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

    def left_out(self, session: Session) -> str | None:  # noqa: ARG002 - most steps can always be done
        """Why this drive cannot have it, or None."""
        return None

    @abstractmethod
    def plan(self, session: Session, /) -> str:
        """What it will do, before it is asked for."""

    @abstractmethod
    def run(self, session: Session) -> Outcome:
        """Do it and check it. Raises StepFailed, or another PeerFault of bus or drive."""
