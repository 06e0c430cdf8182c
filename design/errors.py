"""Failures of a design: values with their evidence, never a solver's trace."""

from dataclasses import dataclass


class DesignError(Exception):
    """Root of what can go wrong in a design that was asked for correctly."""


@dataclass(eq=False)
class NoSolution(DesignError):
    """A solver ended without an optimum, or its answer failed the check that followed."""

    problem: str
    """What was to be solved, in words."""
    status: str
    """What the solver said, or which check failed."""
    evidence: str = ""
    """Figures that show it."""

    def __str__(self) -> str:
        return "; ".join(part for part in (f"{self.problem}: {self.status}", self.evidence) if part)


@dataclass(eq=False)
class InfeasibleDesign(DesignError):
    """No controller of the wanted kind meets the demand; ``best``: the nearest that can be had."""

    demand: str
    """What was asked for, in words with units."""
    best: str
    """The best that can be reached, in words with units."""
    remedy: str
    """What would make the demand feasible."""

    def __str__(self) -> str:
        return f"{self.demand} cannot be reached; {self.best}; {self.remedy}"


@dataclass(eq=False)
class UnsuitableNetwork(DesignError):
    """A network for which the loop that was asked for is not defined."""

    found: str
    expected: str

    def __str__(self) -> str:
        return f"{self.found}: expected {self.expected}"


@dataclass(eq=False)
class CoreNotBuilt(DesignError):
    """The library of design/core is missing, or was built from other sources."""

    found: str
    expected: str

    def __str__(self) -> str:
        return f"the native library of design: found {self.found!r}, expected {self.expected}"


@dataclass(eq=False)
class SingularPlant(DesignError):
    """A plant that breaks an assumption of the synthesis; ``assumption``: its name, A1 to A4."""

    assumption: str
    found: str
    """What is wrong, with its figures."""
    remedy: str
    """What would make the plant regular."""

    def __str__(self) -> str:
        return f"{self.assumption}: {self.found}; {self.remedy}"
