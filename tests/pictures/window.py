"""Whether what is drawn of a short window is true to the cycle: bars of lanes, and gaps in curves."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.hil.recorded.viewer import HeadlessViewer
from tests.pictures.pixels import BARS, CURVES, Picture

_LOST: Final = 1
"""Of the codes of fates."""
_BESIDE_NS: Final = 20 * NS_PER_MS
_READ: Final = ("error", "torque", "delay")
"""Curves of what was read; on the speed lies its estimate, which goes on."""
_PERIOD_NS: Final = NS_PER_MS
"""Of all recordings that are looked at."""

Instants = Callable[[NDArray[np.int64]], NDArray[np.float64]]
"""Of columns of pixels, in ns."""


class Burst(NamedTuple):
    """Cycles in a row that were lost, by the records."""

    first_ns: int
    last_ns: int


def bursts_of(recording: Path) -> list[Burst]:
    """Of one axis, as Arrow alone reads them."""
    table = pa.ipc.open_file(recording / "records.arrow").read_all()
    due_at, fates = table.column("due_at").to_numpy(), table.column("fate").to_numpy()
    edges = np.flatnonzero(np.diff(fates == _LOST, prepend=False, append=False))
    return [Burst(int(due_at[first]), int(due_at[behind - 1])) for first, behind in edges.reshape(-1, 2)]


def look_into(viewer: HeadlessViewer, bursts: Sequence[Burst]) -> tuple[bytes, list[str]]:
    """The picture of a window around the longest burst, and what is wrong with it.

    The cursor, put at the window's quarters in turn, tells which instant each column of pixels is of.
    """
    longest = max(bursts, key=lambda each: each.last_ns - each.first_ns)
    begin_ns, end_ns = longest.first_ns - _BESIDE_NS, longest.last_ns + _BESIDE_NS
    viewer.turn_to("zoom")
    viewer.look_at(begin_ns / NS_PER_S, end_ns / NS_PER_S)
    marks = begin_ns + (end_ns - begin_ns) // 4, begin_ns + 3 * (end_ns - begin_ns) // 4
    pictures = []
    for mark in marks:
        viewer.put_cursor(mark / NS_PER_S)
        pictures.append(viewer.picture())
    inside = [each for each in bursts if each.first_ns < end_ns and each.last_ns > begin_ns]
    return pictures[0], list(untrue(Picture.of_png(pictures[0]), Picture.of_png(pictures[1]), marks, inside))


def untrue(one: Picture, other: Picture, marks: tuple[int, int], bursts: Sequence[Burst]) -> Iterator[str]:
    """What two pictures, with their cursors at ``marks``, ns, show otherwise than ``bursts`` were."""
    lanes = one.bar_rows(BARS["red"])
    if not lanes:
        yield "no lane of dropouts"
        return
    instants = _instants(one, other, lanes, marks)
    drawn = [instants(np.array(each)) for each in one.bars(BARS["red"], lanes)]
    if len(drawn) != len(bursts):
        yield f"{len(drawn)} bars of {len(bursts)} bursts"
    for (begin, end), burst in zip(drawn, bursts, strict=False):
        off_ns = max(abs(begin - burst.first_ns), abs(end - burst.last_ns - _PERIOD_NS))
        if off_ns > _PERIOD_NS:
            yield f"a bar {off_ns / NS_PER_MS:.1f} ms from its rows at {burst.first_ns / NS_PER_S:.3f} s"
    for name in _READ:
        rows = one.curve_rows(CURVES[name])
        columns = one.curve_columns(CURVES[name], rows)
        at = _instants(one, other, rows, marks)(columns)
        for burst in bursts:
            # from the last reading before to the first one behind; a line ends half a cycle off, at most
            within = (at > burst.first_ns - _PERIOD_NS / 2) & (at < burst.last_ns + _PERIOD_NS / 2)
            if within.any():
                yield f"{name} goes on for {within.sum()} px where there was no reading"


def _instants(one: Picture, other: Picture, rows: slice, marks: tuple[int, int]) -> Instants:
    """By the columns of the cursor in these rows of both pictures."""
    first, second = one.cursor(other, rows)
    slope = (marks[1] - marks[0]) / (second - first)
    return lambda columns: np.asarray(marks[0] + (columns - first) * slope, np.float64)
