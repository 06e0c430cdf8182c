"""A recording into one file of another program's format."""

from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from drivers.errors import BadInput
from hil.reviewing.export.matlab import write_mat
from hil.reviewing.export.measurement_data import write_mf4
from hil.reviewing.export.recorded_rows import RecordedRows
from hil.reviewing.export.tables import write_csv, write_parquet
from hil.reviewing.export_format import ExportFormat

_WRITERS: Final[dict[ExportFormat, Callable[[RecordedRows, Path], int]]] = {
    ExportFormat.CSV: write_csv,
    ExportFormat.PARQUET: write_parquet,
    ExportFormat.MF4: write_mf4,
    ExportFormat.MAT: write_mat,
}


class Exported(NamedTuple):
    """What was written."""

    file: str
    rows: int
    columns: int
    bytes: int


def export_run(run: Path, wanted: ExportFormat, out: Path | None = None) -> Exported:
    """Write the rows of ``run`` to ``out``, by default records.ENDING in its folder.

    The file is there as a whole or not at all. Raises BadInput.
    """
    rows = RecordedRows(run)
    path = out or run / f"records.{wanted.value}"
    part = path.with_name(f"{path.name}.part.{wanted.value}")
    try:
        count = _WRITERS[wanted](rows, part)
        part.replace(path)
    except OSError as error:
        raise BadInput("--out", "", str(path), "a file that can be written", str(error)) from None
    finally:
        part.unlink(missing_ok=True)
    return Exported(str(path), count, len(rows.columns), path.stat().st_size)
