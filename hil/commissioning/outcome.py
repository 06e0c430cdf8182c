"""Results of a commissioning step."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final

from servobench.drivers.errors import PeerFault

LOSSES_MAX: Final = 0.1
"""Part of a step's readings that may be lost. A sound bus loses none, a bad one a hundredth; if a tenth is
missing something beyond the drive is wrong, and the torque is unknown for a tenth of the time."""


class StepFailed(PeerFault):
    """A step failed; it may be repeated, or skipped with a reason."""


class ReadingsLost(PeerFault):
    """Bus or machine were disturbed while a step measured; it says nothing about the drive."""


def refuse_losses(lost: int, cycles: int) -> None:
    """Raise ReadingsLost if more were lost than a figure can tolerate."""
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
    """The user skipped it, with a reason."""
    LEFT_OUT = "left out"
    """The drive or the limits do not allow it."""
    NOT_DONE = "not done"
    """A dry run, or an early end."""


@dataclass(frozen=True, slots=True)
class StatedFigure:
    """A figure with its unit, as a report states it."""

    name: str
    value: float
    unit: str
    uncertainty: float | None = None
    """Expanded, k = 2; None if unknown."""


@dataclass(slots=True)
class StepOutcome:
    """Findings of a step."""

    lines: list[str] = field(default_factory=list)
    """Sentences for the report."""
    figures: dict[str, Any] = field(default_factory=dict)
    """Figures for programs."""
    faults: list[str] = field(default_factory=list)
    """Faults in the drive's settings, and their remedies."""
    pictures: list[str] = field(default_factory=list)
    """File names of plots, relative to the report."""
    quantities: list[StatedFigure] = field(default_factory=list)

    headline: str = ""
    """Line for the table at the top of the report; default: the first of ``lines``."""

    def measured(self, name: str, value: float, unit: str, uncertainty: float | None = None) -> None:
        """Add a figure for the report's table."""
        self.quantities.append(StatedFigure(name, float(value), unit, uncertainty))

    def say(self, line: str) -> None:
        """Add a sentence."""
        self.lines.append(line)


@dataclass(slots=True)
class StepRecord:
    """One step in the report."""

    name: str
    title: str
    plan: str
    verdict: StepVerdict
    limit: str = ""
    """Its failure limit."""
    reason: str = ""
    outcome: StepOutcome = field(default_factory=StepOutcome)
    attempts: int = 1
