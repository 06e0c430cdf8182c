"""The files of the frames of a run, which grow together: the frames by column, and their index."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import Duration
from servobench.hil.recording.append_file import AppendFile
from servobench.hil.rows.frames_file import BATCH_FRAMES, FramesWriter, finish_frames
from servobench.hil.rows.frames_index import FramesIndex
from servobench.hil.rows.run_files import FRAMES_FILE, INDEX_FILE


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
    part = path.with_name(f"{path.name}.part")
    try:
        _write_anew(part, path, interfaces, frames, offset)
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        if path.exists():
            with suppress(OSError):
                finish_frames(path)
        raise


def _write_anew(
    part: Path, path: Path, interfaces: tuple[str, ...], frames: NDArray[np.void], offset: Duration
) -> None:
    writer = FramesWriter(part, interfaces)
    try:
        if path.exists():
            writer.copy(path)  # as its seal has it
        for each in parts_of(frames):
            writer.write(each, offset)
        writer.close()
    except OSError:
        writer.drop()  # a file that is open keeps its room on the disk
        raise


def parts_of(frames: NDArray[np.void]) -> Iterator[NDArray[np.void]]:
    """The frames in batches of BATCH_FRAMES at most."""
    for begin in range(0, frames.size, BATCH_FRAMES):
        yield frames[begin : begin + BATCH_FRAMES]
