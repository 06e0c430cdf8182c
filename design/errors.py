"""Failures of a design: values with their evidence, never a solver's trace."""

from dataclasses import dataclass


class DesignError(Exception):
    """Root of the failures of a design that was requested correctly."""


@dataclass(eq=False)
class NoSolution(DesignError):
    """A solver ended without an optimum, or its answer failed the check that followed."""

    problem: str
    """The problem, in words."""
    status: str
    """The solver's status, or the check that failed."""
    evidence: str = ""
    """Figures that show the failure."""

    def __str__(self) -> str:
        return "; ".join(part for part in (f"{self.problem}: {self.status}", self.evidence) if part)


@dataclass(eq=False)
class InfeasibleDesign(DesignError):
    """No controller of the wanted kind meets the demand; ``best``: the nearest one possible."""

    demand: str
    """The demand, in words with units."""
    best: str
    """The best possible value, in words with units."""
    remedy: str
    """A change that would make the demand feasible."""

    def __str__(self) -> str:
        return f"{self.demand} cannot be reached; {self.best}; {self.remedy}"


@dataclass(eq=False)
class UnsuitableNetwork(DesignError):
    """A network for which the requested loop is not defined."""

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
    """The defect, with its figures."""
    remedy: str
    """A change that would make the plant regular."""

    def __str__(self) -> str:
        return f"{self.assumption}: {self.found}; {self.remedy}"
