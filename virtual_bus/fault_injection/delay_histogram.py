"""A delay histogram out of a file: what was measured on a network, to be injected again.

``.csv``: a line for each bar, ``from_us,to_us,count``, each bar from where the last one ends; lines that
begin with ``#`` and a head line of words are passed over. ``.json``: an object with ``edges_us`` (n + 1)
and ``counts`` (n), or one that holds such an object under ``delay_histogram``.
"""

import json
from pathlib import Path
from typing import Any

from drivers.errors import BadInput
from virtual_bus.fault_injection.plan_checks import require

SIZE_MAX_BYTES = 4_000_000
_EXPECTED = "a histogram: .csv lines of from_us,to_us,count, or .json with edges_us and counts"


def read_histogram(path: Path) -> tuple[list[Any], list[Any]]:
    """Edges, us, and counts, as they stand in the file. Raises BadInput about the key ``file``."""
    try:
        require(path.stat().st_size <= SIZE_MAX_BYTES, "file", str(path), "a short file")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise BadInput("", "file", str(path), "a file that can be read", error.strerror or "") from None
    except UnicodeDecodeError as error:
        raise BadInput("", "file", str(path), _EXPECTED, error.reason) from None
    return _from_json(path, text) if path.suffix == ".json" else _from_csv(path, text)


def _from_json(path: Path, text: str) -> tuple[list[Any], list[Any]]:
    try:
        found = json.loads(text)
    except ValueError as error:
        raise BadInput("", "file", str(path), _EXPECTED, str(error)) from None
    if isinstance(found, dict):
        found = found.get("delay_histogram", found)
    usable = isinstance(found, dict) and all(
        isinstance(found.get(key), list) for key in ("edges_us", "counts")
    )
    require(usable, "file", str(path), _EXPECTED)
    return found["edges_us"], found["counts"]


def _from_csv(path: Path, text: str) -> tuple[list[Any], list[Any]]:
    edges: list[Any] = []
    counts: list[Any] = []
    for line_number, line in enumerate(text.splitlines(), start=1):
        fields = [field.strip() for field in line.split(",")]
        if not line.strip() or line.startswith("#") or (not counts and not _is_number(fields[0])):
            continue
        good = len(fields) == 3 and all(map(_is_number, fields[:2])) and fields[2].isdigit()
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
