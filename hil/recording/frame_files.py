"""The files of the frames of a run, which grow together: the frames by column, and their index.

They are written in the order of their instants. The ring holds them in the order of the host's actions: sent
frames have the instant of sending, received ones that of the bus. A host that was held up, by its own waiting
or by a stop of its process, sends first and then fetches the backlog:

    pushed      sent 5.000   received 2.001   received 2.002 ...    on one segment, seconds
    written                  received 2.001   received 2.002 ...   sent 5.000

What was received on a segment comes in its order, up to the jitter of its stamps. So a frame may be written
as soon as every segment has brought one that is later, or brings nothing any more.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.drivers.wire.frame_port import ERROR_FLAG
from servobench.hil.recording.append_file import AppendFile
from servobench.hil.rows.arrow_file import extend
from servobench.hil.rows.frames_file import (
    BATCH_FRAMES,
    FramesIndex,
    FramesWriter,
    batch_of,
    finish_frames,
    frames_schema,
)
from servobench.hil.rows.run_files import FRAMES_FILE, INDEX_FILE
from servobench.hil.rows.side_rows import FRAME_DTYPE

JITTER_NS: Final = 20 * NS_PER_MS
"""How much older a stamp may be than the previous one on its segment: twice a frame at 10 kbit/s, whose end
an adapter may stamp ahead, and the drift of a wall clock being set between two looks at it."""
SILENCE_NS: Final = 200 * NS_PER_MS
"""A segment that brought nothing since the last look is not waited for, once others went on for so long: as
much as a recording may lack that is cut off."""
_EARLIEST: Final = -(2**62)
"""Before every instant, and the time between it and one that a clock shows still has 64 bits."""


class FrameOrder:
    """Holds frames back until no earlier one can come."""

    def __init__(self, segments: int) -> None:
        """``segments``: how many there are."""
        self.late = 0
        """Frames that came after a later one had been written."""
        self._held: NDArray[np.void] = np.empty(0, FRAME_DTYPE)
        self._received_until = [_EARLIEST] * segments
        self._newest = self._let_go_until = _EARLIEST

    def take(self, frames: NDArray[np.void]) -> NDArray[np.void]:
        """Return the frames that may be written now, in order; frames of one instant as they came.

        ``frames``: (n,) of FRAME_DTYPE, what came since the last call.
        """
        if not frames.size:
            return frames
        self.late += int(np.count_nonzero(frames["at"] < self._let_go_until))
        self._newest = max(self._newest, int(frames["at"].max()))
        limit = min(self._limit(segment, frames) for segment in range(len(self._received_until)))
        held = np.concatenate((self._held, frames))
        held = held[np.argsort(held["at"], kind="stable")]
        count = int(np.searchsorted(held["at"], limit, side="right"))
        ready, self._held = held[:count], held[count:].copy()
        if count:
            self._let_go_until = max(self._let_go_until, int(ready["at"][-1]))
        return ready

    @property
    def held(self) -> NDArray[np.void]:
        """Frames that may not be written yet, in order."""
        return self._held

    def rest(self) -> NDArray[np.void]:
        """Return all held frames, in order: nothing more comes."""
        rest, self._held = self._held, self._held[:0]
        return rest

    def _limit(self, segment: int, frames: NDArray[np.void]) -> int:
        """Return the instant until which a segment can bring no further frame, ns."""
        # Simulated error frames are told at their instant, past what waits to be received.
        received = frames.compress((frames["sent"] == 2 * segment) & (frames["can_id"] & ERROR_FLAG == 0))
        if received.size:
            self._received_until[segment] = max(self._received_until[segment], int(received["at"].max()))
            return self._received_until[segment] - JITTER_NS
        return max(self._received_until[segment] - JITTER_NS, self._newest - SILENCE_NS)


class FrameFiles:
    """frames.arrow and frames.index. Each method may raise OSError."""

    def __init__(self, folder: Path, interfaces: tuple[str, ...]) -> None:
        """``interfaces``: names by segment."""
        self._folder, self._interfaces = folder, interfaces
        (folder / FRAMES_FILE).touch()  # its head needs room, which only writing may lack
        self._files: tuple[FramesWriter, AppendFile] | None = None
        self._index = FramesIndex(len(interfaces))
        self.written = 0
        """Frames."""

    def write(self, frames: NDArray[np.void], offset: Duration) -> None:
        """Put (n,) of FRAME_DTYPE behind the others; ``offset``: epoch minus their clock."""
        for part in parts_of(frames):
            columns, index = self._opened()
            begin = columns.write(part, offset)
            self.written += part.size
            index.write(self._index.rows(part, begin, offset).tobytes())

    def close(self) -> None:
        """Nothing comes any more."""
        for file in self._opened():
            file.close()

    def _opened(self) -> tuple[FramesWriter, AppendFile]:
        if self._files is None:
            columns = FramesWriter(self._folder / FRAMES_FILE, self._interfaces)
            self._files = columns, AppendFile(self._folder / INDEX_FILE)
        return self._files


def append_frames(
    path: Path, interfaces: tuple[str, ...], frames: NDArray[np.void], offset: Duration
) -> None:
    """Put (n,) of FRAME_DTYPE behind those of a file that no one writes any more, and end it.

    Error: OSError; it has its own frames then, and its end, if there is room for that.
    """
    if not frames.size and path.exists():
        finish_frames(path)
        return
    schema = frames_schema(interfaces)
    extend(path, schema, (batch_of(each, offset, schema) for each in parts_of(frames)))


def parts_of(frames: NDArray[np.void]) -> Iterator[NDArray[np.void]]:
    """The frames in batches of BATCH_FRAMES at most."""
    for begin in range(0, frames.size, BATCH_FRAMES):
        yield frames[begin : begin + BATCH_FRAMES]
