"""faults.jsonl: what was injected into a run, a line for each entry of its fault log.

The log counts from the first cycle, as all files do, but for a slow drive's entries: those count from the
power-on of the drive, which in simulated time is the beginning. Entries wait until the first cycle is known.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hil.figures.summary import Summary
from hil.recording.log_files import AppendFile
from hil.recording.recording_plan import RecordingPlan
from hil.recording.records import Rows
from hil.recording.ring import RingReader
from hil.recording.run_zero import RunZero
from hil.recording.side_rows import RunEvent
from virtual_bus.fault_injection.fault_log import (
    BLOCK,
    BLOCK_BYTES,
    FAULTS_FILE,
    KIND_CODES,
    Entry,
    entries_of,
    entry_line,
)

BLOCK_DTYPE = np.dtype([("length", "<u4"), ("block", "u1", (BLOCK_BYTES,))])
assert BLOCK_DTYPE.itemsize == BLOCK.size
_SINCE_POWER_ON = frozenset({KIND_CODES["late"], KIND_CODES["boot"]})


class FaultsKeeper:
    """Drains the ring of fault blocks by itself whenever the others get their rows."""

    name = FAULTS_FILE

    def __init__(self, plan: RecordingPlan, blocks: RingReader) -> None:
        self._file = AppendFile(plan.folder / FAULTS_FILE)
        self._blocks = blocks
        self._started_at = plan.started_at
        self._zero = RunZero(plan.started_at)
        self._early: list[Entry] = []

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:  # noqa: ARG002
        """See :class:`hil.recording.log_files.Keeper`."""
        self._zero.look(events)
        for row in self._blocks.drain():
            self._early += entries_of(row["block"].tobytes()[: int(row["length"])])
        if self._zero.told:
            self._write()

    def flush(self) -> None:
        """What waits has no time yet."""

    def finish(self, summary: Summary) -> None:  # noqa: ARG002
        """See :class:`hil.recording.log_files.Keeper`."""
        self._write()
        self._file.close()

    def _write(self) -> None:
        lines = [f"{entry_line(self._in_run_time(entry))}\n" for entry in self._early]
        self._early.clear()
        self._file.write("".join(lines).encode())

    def _in_run_time(self, entry: Entry) -> Entry:
        if entry.code not in _SINCE_POWER_ON:
            return entry
        return entry._replace(at_ns=entry.at_ns + self._started_at - self._zero.at)
