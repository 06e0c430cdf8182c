"""The injected faults of a recording on disk, by column: an Arrow IPC file (Feather version 2) with zstd.

A row is an entry of the run's fault log, in the order of injection. Each number that a kind of fault tells
has a column of its own, and is null in the rows of other kinds and where the kind does without it.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.drivers.bounded_file import NamedBy, opened
from servobench.drivers.errors import BadInput
from servobench.drivers.wire.frame_port import EXTENDED_FLAG, EXTENDED_ID_MAX
from servobench.hil.rows.arrow_file import (
    DAMAGED,
    BatchWriter,
    extend,
    finish,
    is_whole,
    schema_of,
    values_of,
    whole_batches,
)
from servobench.hil.rows.events import ENTRY_DTYPE
from servobench.hil.rows.run_files import FORMAT
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.fates import RecordedFaults
from servobench.virtual_bus.faults.fault_log import AT_NODE, KINDS, entries_of
from servobench.virtual_bus.faults.fault_table import NONE, LogKind, LogNumber
from servobench.virtual_bus.faults.register import LOG_KINDS

BATCH_ENTRIES: Final = 1 << 14
"""Entries of a batch, at 7 bytes each where every frame is delayed: beside them the heads of the columns,
most of which are empty, take 3 %."""
ENTRIES_MAX: Final = 50_000_000
"""Three hours at 1 kHz in which every frame is delayed take 41 million."""
SIZE_MAX_BYTES: Final = 1_000_000_000
_NUMBERS: Final = ("a", "b", "c")
_LABELS: Final = tuple(direction.label for direction in Direction)


def _column_of(kind: LogKind, number: LogNumber) -> str:
    """Name of the column of a number; the frame's own ``node`` is another's."""
    return f"{kind.name}_{number.name}" if number.name == "node" else number.name


_NUMBER_COLUMNS: Final = {_column_of(kind, number): number for kind in LOG_KINDS for number in kind.numbers}


def faults_schema() -> pa.Schema:
    """Return the columns."""

    def field(name: str, kind: pa.DataType, meaning: str, codes: tuple[Any, ...] = ()) -> pa.Field:
        told = {"meaning": meaning}
        if codes:
            told["codes"] = json.dumps({code: str(word) for code, word in enumerate(codes)})
        return pa.field(name, kind, metadata=told)

    fields = [
        field("at_ns", pa.int64(), "when, ns since the first cycle"),
        field("kind", pa.uint8(), "kind of fault", KINDS),
        field("direction", pa.uint8(), "of a frame that was struck", _LABELS),
        field("node", pa.uint8(), "the drive that was struck, or at whose own connection a frame was"),
        field("can_id", pa.uint32(), "of the frame, without flags"),
        field("extended", pa.bool_(), "29 bits"),
        field("n", pa.uint32(), "which frame of its identifier and direction, or which action, from 0 on"),
        *(field(name, pa.int64(), "by kind", number.words) for name, number in _NUMBER_COLUMNS.items()),
    ]
    return pa.schema(fields, metadata={"format": FORMAT})


class FaultsWriter(BatchWriter):
    """Appends batches to a new file. Every method may raise OSError, and leaves whole batches then."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, faults_schema())

    def write(self, entries: NDArray[np.void]) -> None:
        """Append one batch of (n,) of ENTRY_DTYPE in run time."""
        self.append(_batch_of(entries, self.schema))


def append_faults(path: Path, entries: NDArray[np.void]) -> None:
    """Put (n,) of ENTRY_DTYPE in run time behind those of a file that no one writes any more, and end it.

    Error: OSError; it has its own entries then, and its end, if there is room for that.
    """
    if not entries.size and path.exists():
        finish_faults(path)
        return
    schema = faults_schema()
    begins = range(0, entries.size, BATCH_ENTRIES)
    extend(path, schema, (_batch_of(entries[begin : begin + BATCH_ENTRIES], schema) for begin in begins))


def _batch_of(entries: NDArray[np.void], schema: pa.Schema) -> pa.RecordBatch:
    kinds, links = entries["code"], entries["link"]
    at = np.array([kind.at for kind in LOG_KINDS])[kinds]
    tells = np.array([kind.tells for kind in LOG_KINDS])[kinds]
    of_link, of_frame, of_drive = at == "link", tells == "frame", links // AT_NODE
    node = np.where(of_link, of_drive, links)
    values: dict[str, tuple[NDArray[Any], NDArray[np.bool_]]] = {
        "at_ns": (entries["at_ns"], np.ones(entries.size, np.bool_)),
        "kind": (kinds, np.ones(entries.size, np.bool_)),
        "direction": (links % AT_NODE, of_link),
        "node": (node, (at != "host") & (node > 0)),
        "can_id": (entries["can_id"] & EXTENDED_ID_MAX, of_frame),
        "extended": ((entries["can_id"] & EXTENDED_FLAG) != 0, of_frame),
        "n": (entries["n"], tells != "nothing"),
    }
    for name in _NUMBER_COLUMNS:
        values[name] = np.zeros(entries.size, np.int64), np.zeros(entries.size, np.bool_)
    for code in np.unique(kinds):
        mine, kind = np.flatnonzero(kinds == code), LOG_KINDS[code]
        for slot, number in zip(_NUMBERS, kind.numbers, strict=False):
            column, told = values[_column_of(kind, number)]
            column[mine] = entries[slot][mine]
            told[mine] = entries[slot][mine] != NONE if _may_lack(number) else True
    columns = [_array(*values[each.name], each.type) for each in schema]
    return pa.record_batch(columns, schema=schema)


def _array(values: NDArray[Any], told: NDArray[np.bool_], kind: pa.DataType) -> pa.Array:
    return pa.array(np.where(told, values, 0), mask=~told).cast(kind)


def _may_lack(number: LogNumber) -> bool:
    return number.optional or number.usual == NONE


def read_entries(path: Path) -> Iterator[NDArray[np.void]]:
    """Yield the batches, each (n,) of ENTRY_DTYPE in run time. A truncated one ends the file.

    Raises BadInput for one that holds no injected faults, or none that could be.
    """
    codes = _kinds_of(path)
    for place, _, batch in whole_batches(path):
        try:
            yield _entries_of(batch, codes)
        except (pa.ArrowException, ValueError, TypeError, LookupError, OverflowError) as error:
            said = (str(error).splitlines() or [type(error).__name__])[0]
            raise BadInput(str(path), f"byte {place}", said, "a batch of injected faults", DAMAGED) from None


def read_faults(path: Path, named_by: NamedBy | None = None) -> RecordedFaults:
    """Read all of them, as they strike again; ``named_by``: who names the file. Raises BadInput."""
    with opened(path, "file of recorded faults", named_by, SIZE_MAX_BYTES):
        pass  # it can be
    if not is_whole(path):
        expected = "the injected faults of a recording that has ended"
        raise BadInput(str(path), "", "no end of an Arrow file", expected, "hil recover ends one")
    entries = list[bytes]()
    count = 0
    for batch in read_entries(path):
        count += batch.size
        if count > ENTRIES_MAX:
            raise BadInput(str(path), "", f"more than {ENTRIES_MAX} entries", f"at most {ENTRIES_MAX}")
        entries.append(batch.tobytes())
    return RecordedFaults(tuple(entries_of(b"".join(entries))))


def finish_faults(path: Path) -> None:
    """Give a truncated file its footer; needs room for that only. Error: OSError."""
    finish(path, faults_schema())


def _kinds_of(path: Path) -> NDArray[np.int64]:
    """Return the place in KINDS of each code that the file has for a kind; NONE: not known here."""
    schema = schema_of(path)
    if schema is None:
        return np.empty(0, np.int64)
    try:
        told = json.loads((schema.field("kind").metadata or {})[b"codes"])
        names = [told[str(code)] for code in range(len(told))]
    except (LookupError, ValueError, TypeError, AttributeError) as error:
        raise BadInput(str(path), "column kind", repr(error), "the names of the kinds", DAMAGED) from None
    return np.array([KINDS.index(name) if name in KINDS else NONE for name in names], np.int64)


def _entries_of(batch: pa.RecordBatch, codes: NDArray[np.int64]) -> NDArray[np.void]:
    """Inverse of :func:`_batch_of`. Raises ValueError for what no entry can be."""

    def whole(name: str, nothing: int, least: int, most: int) -> NDArray[np.int64]:
        if name not in batch.schema.names:  # of a later version than the file
            return np.full(batch.num_rows, nothing, np.int64)
        values = values_of(batch.column(name).cast(pa.int64()).fill_null(nothing))
        if np.any(((values < least) | (values > most)) & (values != nothing)):
            raise ValueError(f"column {name}: found {values.min()} to {values.max()}, not {least} to {most}")
        return values

    entries = np.zeros(batch.num_rows, ENTRY_DTYPE)
    entries["at_ns"] = whole("at_ns", -(2**62) - 1, -(2**62), 2**62)
    kinds = whole("kind", NONE, 0, codes.size - 1)
    if np.any(kinds == NONE) or np.any(codes[kinds] == NONE):
        raise ValueError("column kind: none, or one that is not known here")
    entries["code"] = codes[kinds]
    at = np.array([kind.at for kind in LOG_KINDS])[entries["code"]]
    node = whole("node", 0, 1, 127)
    direction = whole("direction", 0, 0, len(_LABELS) - 1)
    entries["link"] = np.where(at == "link", direction + AT_NODE * node, node)
    extended = whole("extended", 0, 0, 1)
    entries["can_id"] = whole("can_id", 0, 0, EXTENDED_ID_MAX) | extended * EXTENDED_FLAG
    entries["n"] = whole("n", 0, 0, 2**32 - 1)
    for code in np.unique(entries["code"]):
        mine, kind = entries["code"] == code, LOG_KINDS[code]
        for slot, number in zip(_NUMBERS, kind.numbers, strict=False):
            most = len(number.words) - 1 if number.words else 2**62
            nothing = NONE if _may_lack(number) else 0
            entries[slot][mine] = whole(_column_of(kind, number), nothing, number.least, most)[mine]
    return entries
