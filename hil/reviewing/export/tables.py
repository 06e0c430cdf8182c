"""CSV and Parquet, by pyarrow."""

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from hil.reviewing.export.recorded_rows import RecordedRows


def write_csv(rows: RecordedRows, path: Path) -> int:
    """A head of names with units, words for codes and axes, nothing for null; the number of rows."""
    sink, count = None, 0
    try:
        for chunk in rows.chunks():
            table = _in_words(rows, chunk)
            sink = sink or pyarrow.csv.CSVWriter(str(path), table.schema)
            sink.write_table(table)
            count += table.num_rows
    finally:
        if sink is not None:
            sink.close()
    return count


def _in_words(rows: RecordedRows, chunk: pa.Table) -> pa.Table:
    columns, names = [], []
    for column, values in zip(rows.columns, chunk.columns, strict=True):
        words = rows.axes if column.name == "axis" else column.codes
        if pa.types.is_dictionary(values.type):
            values = values.cast(pa.string())
        elif words:
            values = pc.take(pa.array(words), values)
        columns.append(values)
        names.append(column.unit_name)
    return pa.table(columns, names=names)


def write_parquet(rows: RecordedRows, path: Path) -> int:
    """Columns, units, codes, meanings and metadata as records.arrow has them; the number of rows."""
    count = 0
    # Values that hardly repeat: to look for repetitions takes most of the time, and saves nothing.
    repeating = [field.name for field in rows.schema if field.type not in (pa.int64(), pa.float64())]
    with pyarrow.parquet.ParquetWriter(
        str(path), rows.schema, compression="zstd", use_dictionary=repeating
    ) as sink:
        for chunk in rows.chunks():
            sink.write_table(chunk)
            count += chunk.num_rows
    return count
