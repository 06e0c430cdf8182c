"""Index of the frames in frames.log on which others depend, to read a window without the rest.

The meaning of a frame depends on earlier SDO transfers, on whether its node was heard before, and on node
guarding. The file ``frames.index`` holds, in the order of the log, a row of :data:`INDEX_DTYPE` for each such
line, and one at the end of what was written at once. What lies behind its last row is not in it.
"""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.canopen.cob_ids import ERROR_CONTROL, NODE_BITS, SDO_ANSWER, SDO_REQUEST
from servobench.drivers.wire.identifiers import REMOTE_FLAG, STANDARD_ID_MAX
from servobench.hil.rows.run_files import INDEX_FILE

INDEX_DTYPE: Final = np.dtype([("begin", "<i8"), ("line", "<i8"), ("can_id", "<u4"), ("segment", "<u4")])
"""``begin``: byte of the log at which the line begins; ``line``: its number, from 1 on."""
BORDER: Final = 0xFFFF_FFFF
"""In place of an identifier: the line is where a block of frames ended, and the next one begins."""
_NEWLINE: Final = ord("\n")
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
    """Makes the rows of the index as frames.log grows."""

    def __init__(self, segments: int) -> None:
        """``segments``: how many there are."""
        self._telling = [TellingFrames(first=True) for _ in range(segments)]
        self._bytes = 0
        self._lines = 0

    def rows(self, frames: NDArray[np.void], lines: bytes) -> NDArray[np.void]:
        """Return index rows. ``frames``: (n,) of FRAME_DTYPE, whose n ``lines`` were appended to the previous
        ones."""
        begins = np.append(0, np.flatnonzero(np.frombuffer(lines, np.uint8) == _NEWLINE) + 1)
        can_ids, segments = frames["can_id"].astype(np.int64), frames["sent"] >> 1
        remote = (can_ids & REMOTE_FLAG) != 0
        plain = can_ids & ~REMOTE_FLAG
        ids = np.where(plain <= STANDARD_ID_MAX, plain, 0)
        places = [np.array([frames.size])]
        for number, telling in enumerate(self._telling):
            mine = np.flatnonzero(segments == number)
            places.append(mine[telling.of(ids[mine], remote[mine])])
        place = np.sort(np.concatenate(places))
        rows = np.empty(place.size, INDEX_DTYPE)
        rows["begin"] = self._bytes + begins[place]
        rows["line"] = self._lines + 1 + place
        rows["can_id"] = np.append(ids, BORDER)[place]
        rows["segment"] = np.append(segments, 0)[place]
        self._bytes += len(lines)
        self._lines += frames.size
        return rows


def read_index(folder: Path, log_bytes: int) -> NDArray[np.void]:
    """Read the index of a recording, as far as it goes and fits its log; empty without one."""
    path = folder / INDEX_FILE
    if not path.is_file():
        return np.empty(0, INDEX_DTYPE)
    with path.open("rb") as file:
        whole = path.stat().st_size // INDEX_DTYPE.itemsize * INDEX_DTYPE.itemsize
        rows = np.frombuffer(file.read(whole), INDEX_DTYPE)
    borders = np.flatnonzero(rows["can_id"] == BORDER)
    rows = rows[: int(borders[-1]) + 1 if borders.size else 0]
    begins = rows["begin"]
    if rows.size and (begins[0] < 0 or begins[-1] > log_bytes or np.any(np.diff(begins) < 0)):
        return rows[:0]
    return rows


def needed_before(rows: NDArray[np.void], begin: int) -> NDArray[np.void]:
    """Return the rows of lines before byte ``begin`` on which later ones depend.

    Of node guarding only the last frame of a node counts, and the first one, which tells that it is there.
    """
    told = rows[(rows["begin"] < begin) & (rows["can_id"] != BORDER)]
    keys = told["can_id"].astype(np.int64) | told["segment"].astype(np.int64) << 32
    wanted = _SDO[told["can_id"]]
    wanted[np.unique(keys, return_index=True)[1]] = True
    wanted[told.size - 1 - np.unique(keys[::-1], return_index=True)[1]] = True
    needed: NDArray[np.void] = told[wanted]
    return needed


def needed_behind(rows: NDArray[np.void], end: int) -> NDArray[np.void]:
    """Return the rows of lines from byte ``end`` on in which an earlier SDO transfer may end."""
    told = rows[(rows["begin"] >= end) & (rows["can_id"] != BORDER)]
    needed: NDArray[np.void] = told[_SDO[told["can_id"]]]
    return needed
