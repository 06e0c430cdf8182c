"""The cycles of an axis as Rerun holds them: one entity, a row each, and in it a field for every line.

    /axis1/cycles   row id | run_time | cycles:lines {speed_reference, speed_estimate, speed_measured, ...}

With an entity for each line, row id, instant and list offset stand beside every value: 227 bytes a cycle,
where this takes 27. The layout says which field a line of a plot is drawn from, and how.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from servobench.hil.recording.page_series import Color, Series

if TYPE_CHECKING:
    import rerun as rr
    from rerun.blueprint import Visualizer

COMPONENT: Final = "cycles:lines"
_EXACT: Final = "position/"
"""Lines of many turns, of which one thousandth is looked at: 64 bits. To others 32 are 8 times as fine as
the widest screen, when it shows a hundredth of their range."""


def cycles_entity(axis: str) -> str:
    """The entity that holds the cycles of an axis."""
    return f"/{axis}/cycles"


def field_of(path: str) -> str:
    """The field of a line, by its path below the axis, in letters that a selector can have: a controller's
    signal may be called as it likes."""
    plot, _, line = path.partition("/")
    return f"{plot}_" + "".join(
        each if each.isascii() and each.isalnum() else f"_{ord(each):x}_" for each in line
    )


def cycle_columns(lines: Mapping[str, NDArray[np.float64]]) -> "list[rr.ComponentColumn]":
    """The values of rows, by the path of the line: (n,) each, and no number where a line has a gap."""
    import pyarrow as pa
    import rerun as rr

    kinds = {path: np.float64 if path.startswith(_EXACT) else np.float32 for path in lines}
    values = [pa.array(line.astype(kinds[path])) for path, line in lines.items()]
    rows = pa.StructArray.from_arrays(values, names=[field_of(path) for path in lines])
    return [rr.ComponentColumn(COMPONENT, rr.AnyBatchValue(COMPONENT, rows))]


def drawn(series: Series, color: Color | None = None, name: str = "") -> "Visualizer":
    """A line of a view, from the field of its series; ``color``, ``name`` replace its own."""
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    source = VisualizerComponentMapping(
        "Scalars:scalars",
        ComponentSourceKind.SourceComponent,
        source_component=COMPONENT,
        selector=f".{field_of(series.path)}",
    )
    return series.styled(color, name).visualizer(mappings=[source])
