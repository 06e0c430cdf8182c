"""What a rule is."""

from collections.abc import Callable
from typing import NamedTuple

from tests.contract.conformance.rig import Rig


class Rule(NamedTuple):
    """One rule of a standard and the check of it; each check finds the device just reset."""

    clause: str
    check: Callable[[Rig], None]

    @property
    def name(self) -> str:
        return f"{self.clause}: {self.check.__name__}"


class Rules(list[Rule]):
    """A table of rules, filled by decorating the checks."""

    def of(self, clause: str) -> Callable[[Callable[[Rig], None]], Callable[[Rig], None]]:
        """Enter the decorated check under ``clause``."""

        def enter(check: Callable[[Rig], None]) -> Callable[[Rig], None]:
            self.append(Rule(clause, check))
            return check

        return enter
