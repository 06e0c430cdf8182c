"""What came of a step of commissioning."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final

from servobench.drivers.errors import PeerFault

LOSSES_MAX: Final = 0.1
"""Part of a step's readings that may be lost. A bus in order loses none, a bad one a hundredth; where a tenth
is gone something is wrong that is not the drive's, and the torque is not known for a tenth of the time."""


class StepFailed(PeerFault):
    """A step found what it must not find; it may be repeated, or skipped with a reason."""


class ReadingsLost(PeerFault):
    """Bus or machine were disturbed while a step measured; of the drive that says nothing."""


def refuse_losses(lost: int, cycles: int) -> None:
    """Raises ReadingsLost if more were lost than a figure may rest on."""
    if lost > LOSSES_MAX * cycles:
        raise ReadingsLost(
            f"{lost} of {cycles} readings were lost",
            f"{100.0 * lost / cycles:.1f} %; at most {100.0 * LOSSES_MAX:g} % may be",
            "look at cable, termination and load of the bus (hil measure) and at the load of this machine, "
            "or give a longer period",
        )


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


@dataclass(frozen=True, slots=True)
class StatedFigure:
    """A figure with its unit, as a report states it."""

    name: str
    value: float
    unit: str
    uncertainty: float | None = None
    """Expanded, k = 2; None where none is known."""


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
    quantities: list[StatedFigure] = field(default_factory=list)

    headline: str = ""
    """For the table at the top of the report; the first of ``lines`` if empty."""

    def measured(self, name: str, value: float, unit: str, uncertainty: float | None = None) -> None:
        """Add a figure for the report's table."""
        self.quantities.append(StatedFigure(name, float(value), unit, uncertainty))

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
    limit: str = ""
    """At which it fails."""
    reason: str = ""
    outcome: StepOutcome = field(default_factory=StepOutcome)
    attempts: int = 1
