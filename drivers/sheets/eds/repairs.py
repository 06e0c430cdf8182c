"""Repairs made to a file, and where."""

from typing import NamedTuple

REPAIRS_MAX = 20_000
"""Far more than a careless sheet has; a text that is no data sheet has one in each line."""
_NAME_SHOWN_MAX = 60
"""Characters of a section's name: a file may hold one as long as itself."""


class Repair(NamedTuple):
    """One fault of a file and its repair."""

    section: str
    """The section's name, or "file"."""
    fault: str
    action: str
    line: int = 0
    """Counted from 1; 0 where the fault is in no line, as when something is missing."""

    def __str__(self) -> str:
        place = f"line {self.line} " if self.line else ""
        return f"{place}[{self.section}] {self.fault}: {self.action}"


class NoDataSheet(Exception):
    """The file has more faults than any data sheet; the text says how many."""


class RepairLog:
    """Collects repairs in the order in which they are made."""

    def __init__(self) -> None:
        self._repairs: list[Repair] = []

    def add(self, section: str, fault: str, action: str, line: int = 0) -> None:
        """Note one repair. Raises NoDataSheet if it is one too many."""
        if len(self._repairs) == REPAIRS_MAX:
            raise NoDataSheet(f"more than {REPAIRS_MAX} faults, the last in line {line}")
        self._repairs.append(Repair(section[:_NAME_SHOWN_MAX], fault, action, line))

    def in_order_of_lines(self) -> tuple[Repair, ...]:
        """Return all repairs, those without a line first."""
        return tuple(sorted(self._repairs, key=lambda repair: repair.line))
