"""MATLAB's MAT file, version 5, by scipy: a vector a column, written one after the other."""

from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.io import savemat

from hil.reviewing.export.recorded_rows import RecordedRows

_EXACT_MAX: Final = 1 << 53
"""float64 holds every integer up to here."""
NOTHING: Final = np.iinfo(np.int64).min
"""In place of null, in a column of larger integers: they have no NaN."""


def write_mat(rows: RecordedRows, path: Path) -> int:
    """(n, 1) vectors by column name; also ``units``, ``meanings``, ``codes`` (cells, from 0 on), ``run``.

    An integer column with nulls is float64 with NaN, where that holds its values to the last digit; else
    int64 with its least value for null. Returns the number of rows.
    """
    count = 0
    with path.open("wb") as file:
        for column in rows.columns:
            values = _vector(rows, column.name)
            count = values.size
            _save(file, {column.name: values[:, None]})
        codes = {column.name: list(column.codes) for column in rows.columns if column.codes}
        codes["axis"] = list(rows.axes)
        cells = {name: np.array(words, dtype=object) for name, words in codes.items()}
        _save(file, {"units": {column.name: column.unit for column in rows.columns}})
        _save(file, {"meanings": {column.name: column.meaning for column in rows.columns}})
        _save(file, {"codes": cells})
        _save(file, {"run": dict(rows.metadata)})
    return count


def _save(file: Any, content: dict[str, Any]) -> None:
    savemat(file, content, long_field_names=True, oned_as="column")


def _vector(rows: RecordedRows, name: str) -> NDArray[Any]:
    """(n,) of all rows."""
    parts, exact = [], True
    for chunk in rows.chunks([name]):
        values = chunk.column(0)
        if pa.types.is_dictionary(chunk.schema.types[0]):
            values = pa.chunked_array([part.indices for part in values.chunks], pa.int8())
        parts.append(values)
        if pa.types.is_int64(values.type) and values.null_count < len(values):
            numbers = values.drop_null().to_numpy()
            exact = exact and bool(np.abs(numbers).max(initial=0) <= _EXACT_MAX)
    nulls = any(part.null_count for part in parts)
    return np.concatenate([_plain(part, nulls, exact) for part in parts])


def _plain(part: pa.ChunkedArray, nulls: bool, exact: bool) -> NDArray[Any]:
    if pa.types.is_boolean(part.type):
        part = part.cast(pa.int8())
    if not nulls or pa.types.is_floating(part.type):
        plain: NDArray[Any] = part.to_numpy() if not nulls else part.fill_null(np.nan).to_numpy()
        return plain
    if exact:
        return np.asarray(part.cast(pa.float64()).fill_null(np.nan).to_numpy())
    return np.asarray(part.cast(pa.int64()).fill_null(NOTHING).to_numpy())
