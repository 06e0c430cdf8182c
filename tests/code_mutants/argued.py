"""Safety mutants that no test can tell from the original, each with the reason: ``argued.toml``."""

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from tests.code_mutants.mutations import Place

FILE: Final = Path(__file__).parent / "argued.toml"


@dataclass(slots=True)
class Arguments:
    """What is argued, and what of it was met."""

    why: dict[Place, str]
    met: set[Place] = field(default_factory=set)

    def holds(self, place: Place) -> bool:
        """Whether a survivor is argued equivalent."""
        if place not in self.why:
            return False
        self.met.add(place)
        return True

    def stale(self, seen: Iterable[Place]) -> list[str]:
        """Arguments for what is no mutant of those seen, or was killed."""
        known = set(seen)
        return [
            f"{place}: {'killed, so it is not equivalent' if place in known else 'no such mutant any more'}"
            for place in self.why
            if place not in self.met
        ]


def read_arguments(path: Path = FILE) -> Arguments:
    """The file. Raises ValueError for an argument without a reason, or told twice."""
    why: dict[Place, str] = {}
    for table in tomllib.loads(path.read_text(encoding="utf-8")).get("mutant", []):
        reason = table.pop("why", "")
        place = Place(**table)
        if not reason.strip() or place in why:
            raise ValueError(f"{path.name}: {place}: {'told twice' if reason else 'no reason'}")
        why[place] = reason
    return Arguments(why)
