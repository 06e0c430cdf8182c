"""faults.jsonl: what was injected into a run, a line for each entry of its fault log."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.figures.summary import Summary
from hil.recording.append_file import AppendFile
from hil.recording.records import Rows
from hil.recording.ring import RingReader
from hil.recording.side_rows import RunEvent
from virtual_bus.fault_injection.fault_log import BLOCK, BLOCK_BYTES, FAULTS_FILE, entries_of, entry_line

BLOCK_DTYPE = np.dtype([("length", "<u4"), ("block", "u1", (BLOCK_BYTES,))])
assert BLOCK_DTYPE.itemsize == BLOCK.size


class FaultsKeeper:
    """Drains the ring of fault blocks by itself whenever the others get their rows."""

    name = FAULTS_FILE

    def __init__(self, folder: Path, blocks: RingReader, *, fresh: bool = True) -> None:
        self._file = AppendFile(folder / FAULTS_FILE, fresh=fresh)
        self._blocks = blocks

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:  # noqa: ARG002
        """See :class:`hil.recording.log_files.Keeper`."""
        for row in self._blocks.drain():
            filled = row["block"].tobytes()[: int(row["length"])]
            self._file.write("".join(f"{entry_line(entry)}\n" for entry in entries_of(filled)).encode())

    def flush(self) -> None:
        """Nothing is held back."""

    def finish(self, summary: Summary) -> None:  # noqa: ARG002
        """See :class:`hil.recording.log_files.Keeper`."""
        self._file.close()
