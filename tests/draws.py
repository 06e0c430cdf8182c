"""How many of its drawn cases a test takes: a few in ``make test``, all of them in ``make draws``."""

import os
from collections.abc import Iterable, Sequence
from typing import Final, TypeVar

from hypothesis import settings

Case = TypeVar("Case")
Row = TypeVar("Row")
Column = TypeVar("Column")
ALL: Final = "DRAWS" in os.environ


def few_of(cases: Sequence[Case], count: int) -> Sequence[Case]:
    """Return the first ``count`` of ``cases``, or all of them where the environment has DRAWS."""
    return cases if ALL else cases[:count]


def few_pairs(rows: Iterable[Row], columns: Sequence[Column], each: int) -> list[tuple[Row, Column]]:
    """Return pairs: each row with ``each`` columns, the next row from the next column on; or all of them."""
    return [
        (row, columns[(number + step) % len(columns)])
        for number, row in enumerate(rows)
        for step in range(len(columns) if ALL else each)
    ]


def examples_of(count: int) -> settings:
    """Return settings for ``count`` examples, always the same; without DRAWS for a quarter of them."""
    return settings(derandomize=True, deadline=None, max_examples=count if ALL else max(10, count // 4))
