"""The frames of a recording on disk, by column: an Arrow IPC file (Feather version 2) with zstd.

As in records.arrow the batches are written as they come and the footer at the end; a truncated file is read
up to its last whole batch. Here each batch is also read by its place in the file, so that a window of an hour
costs its own batches.

Index of the frames on which others depend, to read a window without the rest.

The meaning of a frame depends on earlier SDO transfers, on whether its node was heard before, and on node
guarding. The file ``frames.index`` holds, in the order of frames.arrow, a row of :data:`INDEX_DTYPE` for each
such frame, with the frame itself, and before those of a batch one that says where it lies. What lies behind
its last batch is not in it.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.drivers.canopen.cob_ids import ERROR_CONTROL, NODE_BITS, SDO_ANSWER, SDO_REQUEST
from servobench.drivers.errors import BadInput
from servobench.drivers.wire.frame_port import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    EXTENDED_ID_MAX,
    REMOTE_FLAG,
    STANDARD_ID_MAX,
)
from servobench.hil.rows.arrow_file import DAMAGED, BatchWriter, finish, schema_of, values_of, whole_batches
from servobench.hil.rows.run_files import FORMAT, INDEX_FILE
from servobench.hil.rows.side_rows import FRAME_DTYPE

BATCH_FRAMES: Final = 8_192
"""Frames of a batch, at 6 to 10 bytes each; a window decodes whole batches, in some 1 ms each."""
_BYTES: Final = np.arange(8, dtype=np.uint8)


def _field(name: str, kind: pa.DataType, meaning: str, **more: str) -> pa.Field:
    return pa.field(name, kind, nullable=False, metadata={"meaning": meaning, **more})


def frames_schema(interfaces: Sequence[str]) -> pa.Schema:
    """Return the columns; ``interfaces``: their names by segment."""
    codes = json.dumps(dict(enumerate(interfaces)))
    return pa.schema(
        [
            _field("stamp", pa.timestamp("ns", tz="UTC"), "when it was on the bus, or handed over"),
            _field("segment", pa.uint8(), "interface", codes=codes),
            _field("sent", pa.bool_(), "by the bench; else received by it"),
            _field("can_id", pa.uint32(), "11 or 29 bits; of an error frame its class"),
            _field("extended", pa.bool_(), "29 bits"),
            _field("remote", pa.bool_(), "a remote frame"),
            _field("error", pa.bool_(), "an error frame of the adapter"),
            _field("dlc", pa.uint8(), "length of the data", unit="bytes"),
            _field("data", pa.binary(), "the bytes"),
        ],
        metadata={"format": FORMAT, "interfaces": json.dumps(list(interfaces))},
    )


def batch_of(frames: NDArray[np.void], offset: int, schema: pa.Schema) -> pa.RecordBatch:
    """Return a batch of (n,) of FRAME_DTYPE; ``offset``: epoch minus their clock, ns."""
    count, ids = frames.size, frames["can_id"]
    error = (ids & ERROR_FLAG) != 0
    lengths = np.minimum(frames["length"], 8)
    begins = np.zeros(count + 1, np.int32)
    np.cumsum(lengths, out=begins[1:])
    payload = frames["data"][lengths[:, None] > _BYTES].tobytes()
    data = pa.Array.from_buffers(pa.binary(), count, [None, pa.py_buffer(begins), pa.py_buffer(payload)])
    columns = [
        pa.array(frames["at"] + offset, pa.int64()).cast(schema.field("stamp").type),
        pa.array(frames["sent"] >> 1),
        pa.array((frames["sent"] & 1) != 0),
        pa.array(ids & EXTENDED_ID_MAX),
        pa.array(((ids & EXTENDED_FLAG) != 0) & ~error),
        pa.array((ids & REMOTE_FLAG) != 0),
        pa.array(error),
        pa.array(np.ascontiguousarray(frames["length"])),
        data,
    ]
    return pa.record_batch(columns, schema=schema)


def frames_of(batch: pa.RecordBatch) -> NDArray[np.void]:
    """Return (n,) of FRAME_DTYPE whose ``at`` is the stamp, ns since 1970: inverse of :func:`batch_of`."""
    frames = np.zeros(batch.num_rows, FRAME_DTYPE)
    frames["at"] = values_of(batch.column("stamp").view(pa.int64()))
    error, extended = values_of(batch.column("error")), values_of(batch.column("extended"))
    # linux/can.h: an error frame has a 29-bit identifier, its class
    flags = np.where(extended | error, EXTENDED_FLAG, 0) | np.where(error, ERROR_FLAG, 0)
    flags |= np.where(values_of(batch.column("remote")), REMOTE_FLAG, 0)
    frames["can_id"] = values_of(batch.column("can_id")).astype(np.int64) | flags
    frames["sent"] = values_of(batch.column("segment")) << 1 | values_of(batch.column("sent"))
    frames["length"] = values_of(batch.column("dlc"))
    data = batch.column("data")
    _, offsets, payload = data.buffers()
    begins = np.frombuffer(offsets, np.int32, batch.num_rows + 1, data.offset * 4)
    lengths = np.diff(begins)
    if batch.num_rows and (lengths.min() < 0 or lengths.max() > 8):
        raise ValueError("data of more than 8 bytes")
    if payload is not None:
        held = np.frombuffer(payload, np.uint8)[begins[0] : begins[-1]]
        frames["data"][lengths[:, None] > _BYTES] = held
    return frames


class FrameBatch(NamedTuple):
    """A batch where it lies in the file."""

    begin: int
    end: int
    """Bytes."""
    frames: NDArray[np.void]
    """(n,) of FRAME_DTYPE, ``at`` ns since 1970."""


class FramesWriter(BatchWriter):
    """Appends batches to a new file. Every method may raise OSError, and leaves whole batches then."""

    def __init__(self, path: Path, interfaces: Sequence[str]) -> None:
        super().__init__(path, frames_schema(interfaces))

    def write(self, frames: NDArray[np.void], offset: int) -> int:
        """Append one batch of (n,) of FRAME_DTYPE; ``offset``: epoch minus their clock, ns. Return the byte
        at which it begins."""
        return self.append(batch_of(frames, offset, self.schema))


def read_interfaces(path: Path) -> tuple[str, ...]:
    """Names by segment; empty of a file that was truncated before its head. Raises BadInput."""
    schema = schema_of(path)
    try:
        told = json.loads((schema.metadata or {})[b"interfaces"]) if schema is not None else []
    except (KeyError, ValueError) as error:
        raise BadInput(str(path), "interfaces", repr(error), "their names", DAMAGED) from None
    return tuple(map(str, told))


def read_batches(path: Path, begin: int = 0) -> Iterator[FrameBatch]:
    """Yield the batches in order, from the one at byte ``begin`` on. A truncated one ends the file.

    Raises BadInput for one that holds no frames.
    """
    for place, end, batch in whole_batches(path, begin):
        try:
            frames = frames_of(batch)
        except (pa.ArrowException, ValueError, TypeError, LookupError) as error:
            said = (str(error).splitlines() or [type(error).__name__])[0]
            raise BadInput(str(path), f"byte {place}", said, "a batch of frames", DAMAGED) from None
        yield FrameBatch(place, end, frames)


def finish_frames(path: Path) -> None:
    """Give a truncated file its footer; needs room for that only. Error: OSError."""
    finish(path, frames_schema(()))


INDEX_DTYPE: Final = np.dtype(
    [
        ("number", "<i8"), ("begin", "<i8"), ("at", "<i8"), ("can_id", "<u4"),
        ("length", "u1"), ("sent", "u1"), ("data", "u1", (8,)),
    ]
)  # fmt: skip
"""``number``: of the frame, from 1 on; ``begin``: byte of frames.arrow at which its batch begins; the frame
as in FRAME_DTYPE, ``at`` ns since 1970."""
BATCH: Final = 0xFFFF_FFFF
"""In place of an identifier: here a batch begins, whose first frame has this number and stamp."""
_FRAME: Final = ("at", "can_id", "length", "sent", "data")
_SDO: Final = np.zeros(STANDARD_ID_MAX + 1, np.bool_)
"""By identifier."""
for _service in (SDO_ANSWER, SDO_REQUEST):
    _SDO[_service + 1 : _service + NODE_BITS + 1] = True


class TellingFrames:
    """Selects frames on which the meaning of others depends."""

    def __init__(self, *, first: bool) -> None:
        """``first``: include the first frame of each identifier, which shows that the node exists."""
        self._first = ~_SDO if first else np.zeros_like(_SDO)
        self._always = _SDO.copy()

    def of(self, ids: NDArray[np.integer], remote: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return places among ``ids``, (n,), of one bus in order; 0 for a frame without a standard
        identifier."""
        guarded = ids[remote]
        self._always[guarded[(guarded & ~NODE_BITS) == ERROR_CONTROL]] = True
        fresh = np.flatnonzero(self._first[ids])
        fresh = fresh[np.unique(ids[fresh], return_index=True)[1]]
        self._first[ids[fresh]] = False
        return np.union1d(np.flatnonzero(self._always[ids]), fresh)


class FramesIndex:
    """Makes the rows of the index as frames.arrow grows."""

    def __init__(self, segments: int) -> None:
        """``segments``: how many there are."""
        self._telling = [TellingFrames(first=True) for _ in range(segments)]
        self._count = 0

    def know(self, rows: NDArray[np.void], count: int) -> None:
        """Go on behind an index of ``count`` frames."""
        told = rows.compress(rows["can_id"] != BATCH)
        for number, telling in enumerate(self._telling):
            mine = told["can_id"][told["sent"] >> 1 == number]
            telling.of(_standard(mine), (mine & REMOTE_FLAG) != 0)
        self._count = count

    def rows(self, frames: NDArray[np.void], begin: int, offset: int = 0) -> NDArray[np.void]:
        """Return the index rows of the next batch, (n,) of FRAME_DTYPE, at byte ``begin``; ``offset``: what
        makes their instants stamps."""
        if not frames.size:
            return np.empty(0, INDEX_DTYPE)
        ids, segments = _standard(frames["can_id"]), frames["sent"] >> 1
        remote = (frames["can_id"] & REMOTE_FLAG) != 0
        places = []
        for number, telling in enumerate(self._telling):
            mine = np.flatnonzero(segments == number)
            places.append(mine[telling.of(ids[mine], remote[mine])])
        place = np.sort(np.concatenate(places))
        rows = np.empty(1 + place.size, INDEX_DTYPE)
        place = np.append(0, place)
        for name in _FRAME:
            rows[name] = frames[name][place]
        rows["number"] = self._count + 1 + place
        rows["begin"] = begin
        rows["at"] += offset
        rows["can_id"][0] = BATCH
        self._count += frames.size
        return rows


def _standard(can_ids: NDArray[np.void]) -> NDArray[np.int64]:
    """Standard identifiers, 0 in place of others."""
    plain = can_ids.astype(np.int64) & ~REMOTE_FLAG
    return np.where(plain <= STANDARD_ID_MAX, plain, 0)


def read_index(folder: Path) -> NDArray[np.void]:
    """Read the index of a recording, as far as it goes; empty without one, and where it cannot be one."""
    path = folder / INDEX_FILE
    if not path.is_file():
        return np.empty(0, INDEX_DTYPE)
    with path.open("rb") as file:
        whole = path.stat().st_size // INDEX_DTYPE.itemsize * INDEX_DTYPE.itemsize
        rows = np.frombuffer(file.read(whole), INDEX_DTYPE)
    if rows.size and (rows["can_id"][0] != BATCH or np.any(np.diff(rows["begin"]) < 0)):
        return rows[:0]
    return rows


def indexed_batches(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return the rows that tell where a batch lies."""
    batches: NDArray[np.void] = rows.compress(rows["can_id"] == BATCH)
    return batches


def needed_before(rows: NDArray[np.void], number: int) -> NDArray[np.void]:
    """Return those of frames before ``number`` on which later ones depend.

    Of node guarding only the last frame of a node counts, and the first one, which tells that it is there.
    """
    told = rows.compress((rows["number"] < number) & (rows["can_id"] != BATCH))
    ids = _standard(told["can_id"])
    keys = ids | (told["sent"].astype(np.int64) >> 1) << 32
    wanted = _SDO[ids]
    wanted[np.unique(keys, return_index=True)[1]] = True
    wanted[told.size - 1 - np.unique(keys[::-1], return_index=True)[1]] = True
    needed: NDArray[np.void] = told[wanted]
    return needed


def needed_behind(rows: NDArray[np.void], number: int) -> NDArray[np.void]:
    """Return those of frames from ``number`` on in which an earlier SDO transfer may end."""
    told = rows.compress((rows["number"] >= number) & (rows["can_id"] != BATCH))
    needed: NDArray[np.void] = told[_SDO[_standard(told["can_id"])]]
    return needed
