"""What had to be mended in a file, and where."""

from typing import NamedTuple


class Repair(NamedTuple):
    """One fault of a file and what was made of it."""

    section: str
    """The section's name, or "file"."""
    fault: str
    action: str
    line: int = 0
    """Counted from 1; 0 where the fault is in no line, as when something is missing altogether."""

    def __str__(self) -> str:
        place = f"line {self.line} " if self.line else ""
        return f"{place}[{self.section}] {self.fault}: {self.action}"


class RepairLog:
    """Collects repairs in the order in which they are made."""

    def __init__(self) -> None:
        self._repairs: list[Repair] = []

    def add(self, section: str, fault: str, action: str, line: int = 0) -> None:
        """Note one repair."""
        self._repairs.append(Repair(section, fault, action, line))

    def in_order_of_lines(self) -> tuple[Repair, ...]:
        """All repairs, those without a line first."""
        return tuple(sorted(self._repairs, key=lambda repair: repair.line))
