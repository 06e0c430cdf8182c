"""``[[measured_delay]]``: frames are held as was measured on a network."""

import re
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationInfo, model_validator

from servobench.drivers.bounded_file import NamedBy, parse_json, read_text
from servobench.drivers.errors import MISSING
from servobench.drivers.timebase import NS_PER_US
from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import DELAY_MAX, Number, ns, require
from servobench.virtual_bus.faults.frame_fault import FrameFault, Hold, MeasuredHold

COUNT_MAX = 1 << 53
"""Limit of a bar's count: the exact range of a float."""


class MeasuredDelay(FrameFault):
    """A frame is held for a time drawn from a histogram: a bar by its count, evenly within the bar.

    Otherwise as :class:`.delay.Delay`, and so it stands in the log.
    """

    kind = "measured_delay"
    delays = True
    edges_us: Annotated[tuple[Number, ...], Field(strict=False, description="numbers")]
    """n + 1 rising times."""
    counts: Annotated[tuple[int, ...], Field(strict=False, description="whole numbers")]
    """n."""
    file: str | None = None
    """Instead of both, a path from the plan's folder; read at once, and then None."""
    reorder: bool = False

    @model_validator(mode="before")
    @classmethod
    def _read_file(cls, table: Mapping[str, Any], info: ValidationInfo) -> Mapping[str, Any]:
        if "file" not in table:
            for key in ("edges_us", "counts"):
                require(key in table, key, MISSING, "a list of times, or file instead")
            return table
        for key in ("edges_us", "counts"):
            require(key not in table, key, table.get(key), "nothing beside file")
        name = table["file"]
        require(isinstance(name, str), "file", name, "the path of a histogram in quotes")
        source = Path((info.context or {}).get("source", ""))
        edges, counts = read_histogram(source.parent / name)
        return {**table, "edges_us": edges, "counts": counts, "file": None}

    @model_validator(mode="after")
    def _check_histogram(self) -> "MeasuredDelay":
        edges, counts = self.edges_us, self.counts
        rising = len(edges) >= 2 and all(low < high for low, high in pairwise(self._edges_ns))
        require(rising, "edges_us", list(edges), "at least two times, each above the last")
        longest = f"times from 0 to {DELAY_MAX // NS_PER_US} us"
        inside = self._edges_ns[0] >= 0 and self._edges_ns[-1] <= DELAY_MAX
        require(inside, "edges_us", list(edges), longest)
        expected = f"{len(edges) - 1} counts, one less than edges_us"
        require(len(counts) == len(edges) - 1, "counts", list(counts), expected)
        usable = all(0 <= count <= COUNT_MAX for count in counts) and sum(counts) > 0
        require(usable, "counts", list(counts), "whole numbers >= 0, not all of them 0")
        return self

    @property
    def _edges_ns(self) -> list[int]:
        return [ns(edge, "us") for edge in self.edges_us]

    def at_work(self, stream: UniformStream) -> Hold:
        return MeasuredHold(self.window, not self.reorder, self._edges_ns, self.counts, stream)


_COUNT = re.compile(r"[0-9]{1,18}")
"""Below 2**63."""
_EXPECTED = "a histogram: .csv lines of from_us,to_us,count, or .json with edges_us and counts"


def read_histogram(path: Path) -> tuple[list[Any], list[Any]]:
    """Edges, us, and counts, as they stand in the file. Raises BadInput about the key ``file``.

    ``.csv``: a line for each bar, ``from_us,to_us,count``, each bar from where the last one ends; lines that
    begin with ``#`` and a head line of words are passed over. ``.json``: an object with ``edges_us`` (n + 1)
    and ``counts`` (n), or one that holds such an object under ``delay_histogram``.
    """
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
