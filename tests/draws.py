"""How many of its drawn cases a test takes: a few in ``make test``, all of them in ``make draws``."""

import os
from collections.abc import Sequence
from typing import Final, TypeVar

Case = TypeVar("Case")
ALL: Final = "DRAWS" in os.environ


def few_of(cases: Sequence[Case], count: int) -> Sequence[Case]:
    """Return the first ``count`` of ``cases``, or all of them where the environment has DRAWS."""
    return cases if ALL else cases[:count]
