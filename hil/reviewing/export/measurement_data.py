"""ASAM MDF 4, by asammdf: a channel group an axis, its time the tick of the cycle in s."""

import sys
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from drivers.errors import BadInput
from drivers.timebase import NS_PER_S
from hil.reviewing.export.recorded_rows import ExportColumn, RecordedRows

_TIME, _AXIS = "due_at", "axis"
_INSTALL = "pip install 'servobench[mf4]'"


def write_mf4(rows: RecordedRows, path: Path) -> int:
    """Null is a sample that is marked invalid. Returns the number of rows. Raises BadInput."""
    try:
        asammdf: Any = import_module("asammdf")
    except ImportError:
        raise BadInput("--to", "", "mf4", "the package asammdf for this format", _INSTALL) from None
    columns = [column for column in rows.columns if column.name not in (_TIME, _AXIS)]
    count = 0
    # asammdf prints how fast it packs; stdout belongs to the command.
    with redirect_stdout(sys.stderr), asammdf.MDF(version="4.10") as sink:
        groups: dict[int, int] = {}
        for chunk in rows.chunks():
            count += chunk.num_rows
            for axis in pc.unique(chunk[_AXIS]).to_pylist():
                mine = chunk.filter(pc.equal(chunk[_AXIS], axis))
                if axis in groups:
                    sink.extend(groups[axis], _pieces(mine, columns))
                else:
                    groups[axis] = _begin(asammdf, sink, rows.axes[axis], mine, columns)
        sink.header.comment = "\n".join(f"{key}: {value}" for key, value in rows.metadata.items())
        sink.save(path, overwrite=True, compression=2)
    return count


def _begin(asammdf: Any, sink: Any, axis: str, mine: pa.Table, columns: list[ExportColumn]) -> int:
    """A group with its first rows; its number."""
    times = mine[_TIME].to_numpy() / NS_PER_S
    signals = []
    for column in columns:
        samples, invalid = _samples(mine[column.name])
        told = f"{column.meaning} ({', '.join(column.codes)})" if column.codes else column.meaning
        signals.append(
            asammdf.Signal(
                samples,
                times,
                unit=column.unit,
                name=f"{axis}.{column.name}",
                comment=told,
                invalidation_bits=invalid,
            )
        )
    number: int = sink.append(signals, acq_name=axis, comment=axis, common_timebase=True)
    return number


def _pieces(
    mine: pa.Table, columns: list[ExportColumn]
) -> list[tuple[NDArray[Any], NDArray[np.bool_] | None]]:
    """What a group is extended by: its time first."""
    times = mine[_TIME].to_numpy() / NS_PER_S
    return [(times, None), *(_samples(mine[column.name]) for column in columns)]


def _samples(values: pa.ChunkedArray) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Numbers, 0 for null; where they are null."""
    if pa.types.is_dictionary(values.type):
        values = pa.chunked_array([part.indices for part in values.chunks], pa.int8())
    if pa.types.is_boolean(values.type):
        values = values.cast(pa.uint8())
    invalid = np.asarray(values.is_null().to_numpy(), bool)
    filled = values.fill_null(0).to_numpy() if values.null_count else values.to_numpy()
    return np.ascontiguousarray(filled), invalid
