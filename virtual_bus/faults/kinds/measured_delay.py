"""``[[measured_delay]]``: frames are held as was measured on a network."""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationInfo, model_validator

from drivers.errors import MISSING
from drivers.timebase import NS_PER_US
from virtual_bus.faults.delay_histogram import read_histogram
from virtual_bus.faults.fault_streams import UniformStream
from virtual_bus.faults.fault_table import DELAY_MAX, Number, ns, require
from virtual_bus.faults.frame_fault import FrameFault
from virtual_bus.faults.strikes import Hold, MeasuredHold

COUNT_MAX = 1 << 53
"""Of a bar: as far as a float counts."""


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
