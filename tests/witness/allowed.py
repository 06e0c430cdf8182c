"""Objects that a command may write, by docs/writes.md, and a maker's that it may read, by drivers/vendors:
the documents as their reader has them, never the code that makes or uses them."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

ROOT: Final = Path(__file__).parents[2]
_ROW: Final = re.compile(r"\| ([0-9A-F]{4})h(?:-([0-9A-F]{4})h)?:([0-9A-F,-]+) \|(.*)\| ([a-z, ]+) \|")
MAKERS: Final = range(0x2000, 0x6000)
"""CiA 301 7.4.1: manufacturer-specific profile area."""


class Documented(NamedTuple):
    """What the documents allow on a drive of any make but this product."""

    writes: dict[str, frozenset[tuple[int, int]]]
    """Index and sub-index, by command."""
    maker_reads: frozenset[int]


def documented() -> Documented:
    """Of commission and run. Raises ValueError if the page has no table any more."""
    text = (ROOT / "docs" / "writes.md").read_text()
    rows = [match for line in text.splitlines() if (match := _ROW.match(line))]
    if len(rows) < 10:
        raise ValueError("docs/writes.md: no table of objects")
    writes = {
        command: frozenset(key for row in rows if command in row[5].split(", ") for key in _objects(row))
        for command in ("commission", "run")
    }
    files = sorted((ROOT / "drivers" / "vendors").glob("*.toml"))
    reads = frozenset(index for file in files for index in _indices(tomllib.loads(file.read_text())))
    return Documented(writes, reads)


def _objects(row: re.Match[str]) -> Iterator[tuple[int, int]]:
    first = int(row[1], 16)
    for index in range(first, int(row[2] or row[1], 16) + 1):
        if index in MAKERS:  # of this product alone
            continue
        for part in row[3].split(","):
            low, _, high = part.partition("-")
            yield from ((index, sub) for sub in range(int(low, 16), int(high or low, 16) + 1))


def _indices(table: Any) -> Iterator[int]:
    """Values of every key that ends in ``index``, however deep."""
    for key, value in table.items() if isinstance(table, dict) else ():
        if str(key).endswith("index") and isinstance(value, int):
            yield value
        for each in value if isinstance(value, list) else [value]:
            yield from _indices(each)
