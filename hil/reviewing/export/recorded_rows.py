"""records.arrow of a finished run, batch by batch, with what its columns mean."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import pyarrow as pa

from drivers.errors import BadInput
from hil.rows.records_file import RECORDS_FILE, is_whole, refuse_later_format

CHUNK_ROWS: Final = 1 << 17
"""Rows that are held at once: some 40 MB with all columns, and enough for a row group of Parquet."""


class ExportColumn(NamedTuple):
    """A column as its field in the file tells it."""

    name: str
    unit: str
    meaning: str
    codes: tuple[str, ...]
    """What its numbers stand for, from 0 on."""

    @property
    def unit_name(self) -> str:
        """The name with its unit, where a file has no other place for it: ``due_at_ns``."""
        instant = self.unit.startswith("ns") and not self.name.endswith("_ns")
        return f"{self.name}_ns" if instant else self.name


class RecordedRows:
    """The rows of a run. What an earlier format had no column for is not there."""

    def __init__(self, folder: Path) -> None:
        """Raises BadInput for a folder without records, records without an end, and a later format."""
        self.path = folder / RECORDS_FILE
        if not self.path.is_file():
            raise BadInput(str(folder), "", "no records.arrow", "the folder of a recording")
        if not is_whole(self.path):
            remedy = f"once it has ended: hil recover {folder}"
            raise BadInput(
                str(self.path), "", "no end of the file", "the recording of a run that has ended", remedy
            )
        self.schema = self._open(None).schema
        told = self.schema.metadata or {}
        self.metadata: Mapping[str, str] = {key.decode(): value.decode() for key, value in told.items()}
        refuse_later_format(self.metadata, self.path)
        self.columns = tuple(_column(field) for field in self.schema)

    @property
    def axes(self) -> tuple[str, ...]:
        """Names by number."""
        names: list[str] = json.loads(self.metadata.get("axes", "[]"))
        return tuple(names)

    def chunks(self, names: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """The rows in order, CHUNK_ROWS and a batch at a time at most; ``names``: of these columns alone."""
        reader = self._open(names)
        held: list[pa.RecordBatch] = []
        for number in range(reader.num_record_batches):
            held.append(reader.get_batch(number))
            if sum(batch.num_rows for batch in held) >= CHUNK_ROWS:
                yield pa.Table.from_batches(held).combine_chunks()
                held = []
        yield pa.Table.from_batches(held, reader.schema).combine_chunks()

    def _open(self, names: Sequence[str] | None) -> pa.ipc.RecordBatchFileReader:
        try:
            if names is None:
                return pa.ipc.open_file(pa.OSFile(str(self.path), "rb"))
            places = [self.schema.get_field_index(name) for name in names]
            options = pa.ipc.IpcReadOptions(included_fields=places)
            return pa.ipc.open_file(pa.OSFile(str(self.path), "rb"), options=options)
        except (pa.ArrowInvalid, OSError) as error:
            raise BadInput(str(self.path), "", str(error), "an Arrow IPC file") from None


def _column(field: pa.Field) -> ExportColumn:
    told = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    codes: dict[str, str] = json.loads(told.get("codes", "{}"))
    in_order = tuple(codes[number] for number in sorted(codes, key=int))
    return ExportColumn(field.name, told.get("unit", ""), told.get("meaning", ""), in_order)
