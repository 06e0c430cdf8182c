"""Index of the frames on which others depend, to read a window without the rest.

The meaning of a frame depends on earlier SDO transfers, on whether its node was heard before, and on node
guarding. The file ``frames.index`` holds, in the order of frames.arrow, a row of :data:`INDEX_DTYPE` for each
such frame, with the frame itself, and before those of a batch one that says where it lies. What lies behind
its last batch is not in it.
"""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.canopen.cob_ids import ERROR_CONTROL, NODE_BITS, SDO_ANSWER, SDO_REQUEST
from servobench.drivers.wire.identifiers import REMOTE_FLAG, STANDARD_ID_MAX
from servobench.hil.rows.run_files import INDEX_FILE

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
        told = rows[rows["can_id"] != BATCH]
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
    batches: NDArray[np.void] = rows[rows["can_id"] == BATCH]
    return batches


def needed_before(rows: NDArray[np.void], number: int) -> NDArray[np.void]:
    """Return those of frames before ``number`` on which later ones depend.

    Of node guarding only the last frame of a node counts, and the first one, which tells that it is there.
    """
    told = rows[(rows["number"] < number) & (rows["can_id"] != BATCH)]
    ids = _standard(told["can_id"])
    keys = ids | (told["sent"].astype(np.int64) >> 1) << 32
    wanted = _SDO[ids]
    wanted[np.unique(keys, return_index=True)[1]] = True
    wanted[told.size - 1 - np.unique(keys[::-1], return_index=True)[1]] = True
    needed: NDArray[np.void] = told[wanted]
    return needed


def needed_behind(rows: NDArray[np.void], number: int) -> NDArray[np.void]:
    """Return those of frames from ``number`` on in which an earlier SDO transfer may end."""
    told = rows[(rows["number"] >= number) & (rows["can_id"] != BATCH)]
    needed: NDArray[np.void] = told[_SDO[_standard(told["can_id"])]]
    return needed
