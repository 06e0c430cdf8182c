"""faults.jsonl: what was injected into a run, a line for each entry of its fault log.

The log counts from the first cycle, as all files do, but for the entries of what a drive has from its
power-on: those count from there, which in simulated time is the beginning. Entries wait until the first cycle
is known.
"""

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import Instant
from servobench.hil.rows.run_zero import RunZero
from servobench.virtual_bus.faults.fault_log import (
    BLOCK,
    BLOCK_BYTES,
    FaultEntry,
    entries_of,
)
from servobench.virtual_bus.faults.register import LOG_KINDS

BLOCK_DTYPE = np.dtype([("length", "<u4"), ("block", "u1", (BLOCK_BYTES,))])
assert BLOCK_DTYPE.itemsize == BLOCK.size
_SINCE_POWER_ON = frozenset(code for code, kind in enumerate(LOG_KINDS) if kind.since_power_on)


class FaultEntries:
    """The entries of a run in run time, as its ring brings them."""

    def __init__(self, started_at: Instant) -> None:
        """``started_at``: when the drives were switched on."""
        self.fresh: list[FaultEntry] = []
        """Those of the last :meth:`take`."""
        self._started_at = started_at
        self._early: list[FaultEntry] = []

    def take(self, blocks: NDArray[np.void], zero: RunZero, at_end: bool = False) -> list[FaultEntry]:
        """Those in ``blocks``: (n,) of BLOCK_DTYPE. They wait for the first cycle, unless it never comes."""
        for row in blocks:
            self._early += entries_of(row["block"].tobytes()[: int(row["length"])])
        self.fresh = []
        if zero.told or at_end:
            self.fresh = [self._in_run_time(entry, zero.at) for entry in self._early]
            self._early.clear()
        return self.fresh

    def _in_run_time(self, entry: FaultEntry, zero: Instant) -> FaultEntry:
        if entry.code not in _SINCE_POWER_ON:
            return entry
        return entry._replace(at_ns=entry.at_ns + self._started_at - zero)
