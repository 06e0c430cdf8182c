"""A delay histogram out of a file: what was measured on a network, to be injected again.

``.csv``: a line for each bar, ``from_us,to_us,count``, each bar from where the last one ends; lines that
begin with ``#`` and a head line of words are passed over. ``.json``: an object with ``edges_us`` (n + 1)
and ``counts`` (n), or one that holds such an object under ``delay_histogram``.
"""

import re
from pathlib import Path
from typing import Any

from drivers.bounded_file import NamedBy, parse_json, read_text
from virtual_bus.faults.fault_table import require

_COUNT = re.compile(r"[0-9]{1,18}")
"""Below 2**63."""
_EXPECTED = "a histogram: .csv lines of from_us,to_us,count, or .json with edges_us and counts"


def read_histogram(path: Path) -> tuple[list[Any], list[Any]]:
    """Edges, us, and counts, as they stand in the file. Raises BadInput about the key ``file``."""
    text = read_text(path, "delay histogram", NamedBy("", "file", str(path)))
    return _from_json(path, text) if path.suffix == ".json" else _from_csv(path, text)


def _from_json(path: Path, text: str) -> tuple[list[Any], list[Any]]:
    tables = parse_json(text, str(path), _EXPECTED, "file")
    if isinstance(tables, dict):
        tables = tables.get("delay_histogram", tables)
    usable = isinstance(tables, dict) and all(
        isinstance(tables.get(key), list) for key in ("edges_us", "counts")
    )
    require(usable, "file", str(path), _EXPECTED)
    return tables["edges_us"], tables["counts"]


def _from_csv(path: Path, text: str) -> tuple[list[Any], list[Any]]:
    edges: list[Any] = []
    counts: list[Any] = []
    for line_number, line in enumerate(text.splitlines(), start=1):
        fields = [field.strip() for field in line.split(",")]
        if not line.strip() or line.startswith("#") or (not counts and not _is_number(fields[0])):
            continue
        good = (
            len(fields) == 3 and all(map(_is_number, fields[:2])) and _COUNT.fullmatch(fields[2]) is not None
        )
        require(good, "file", f"{path}, line {line_number}: {line.strip()[:60]}", "from_us,to_us,count")
        low, high = float(fields[0]), float(fields[1])
        if not edges:
            edges.append(low)
        expected = f"a bar from {edges[-1]:g} us, where the last one ends"
        require(low == edges[-1], "file", f"{path}, line {line_number}: {line.strip()[:60]}", expected)
        edges.append(high)
        counts.append(int(fields[2]))
    return edges, counts


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
