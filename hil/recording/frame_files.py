"""The files of the frames of a run, which grow together: the log, its directions and its index."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import Instant
from servobench.hil.recording.append_file import AppendFile
from servobench.hil.recording.candump import candump_lines, direction_lines
from servobench.hil.rows.frames_index import FramesIndex
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.run_files import DIRECTIONS_FILE, FRAMES_FILE, INDEX_FILE


class FrameFiles:
    """frames.log, frames.directions and frames.index. Each method may raise OSError."""

    def __init__(self, plan: RecordingPlan, folder: Path, *, fresh: bool = True) -> None:
        """Not ``fresh``: log and directions go on behind what they have, the index stays as it is."""
        self._plan = plan
        self._log = AppendFile(folder / FRAMES_FILE, fresh=fresh)
        self._directions = AppendFile(folder / DIRECTIONS_FILE, fresh=fresh)
        self._indexed = AppendFile(folder / INDEX_FILE) if fresh else None
        self._index = FramesIndex(1 + len(plan.segments))
        self.written = 0
        """Frames."""

    def write(self, frames: NDArray[np.void], zero: Instant) -> None:
        """Put (n,) of FRAME_DTYPE behind the others; ``zero``: the first cycle."""
        if not frames.size:
            return
        plan = self._plan
        # Its direction first: no frame is there without one, wherever the two are cut off.
        self._directions.write(direction_lines(frames))
        lines = candump_lines(frames, plan.bus.rpartition(":")[2], plan.stamp_offset(zero), plan.segments)
        self._log.write(lines)
        if self._indexed is not None:
            self._indexed.write(self._index.rows(frames, lines).tobytes())
        self.written += frames.size

    def close(self) -> None:
        """Nothing comes any more."""
        self._log.close()
        self._directions.close()
        if self._indexed is not None:
            self._indexed.close()
