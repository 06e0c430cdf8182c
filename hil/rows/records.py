"""Rows of cycle records as numpy has them, and what of them the digest covers.

States that follow from the records alone: the drive's from its statusword, the link's from dropouts, the
host's from the cycles that went without SYNC.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.cia402.profile import STATE_BITS, state_of
from servobench.drivers.exchange import NEVER_TOLD
from servobench.hil.loop.cycle_record import CAUSES, COLUMNS, FATE_MISSED, FATE_SAMPLE, NAMES
from servobench.hil.rows.events import QUIET

DIGESTED: Final = tuple(
    [place for place, name in enumerate(NAMES) if name != "compute_ns" and not name.startswith("channel_")]
)
"""Places of the columns that the digest covers; every one has eight bytes. In simulated time they follow from
the bench file and the seed, unlike the host's computing time and a user controller's channels."""
DIGESTED_TO_FORMAT_2: Final = tuple(range(NAMES.index("compute_ns")))
"""The same of recordings of formats 1 and 2: without the last four columns."""

ROW_DTYPE: Final = np.dtype([(column.name, "<f8" if column.is_real else "<i8") for column in COLUMNS])
"""A packed row. A real number that there is none of is NaN, a whole number NOTHING."""

Rows = NDArray[np.void]
"""(n,) of ROW_DTYPE. Choose some of them by ``compress``, which copies whole rows; a mask in brackets copies
field by field and takes nine times as long."""


LINK_OK_CYCLES = 1000
"""So many cycles without a dropout make a link that is OK: one in which 2 % are lost never is."""
LINK_DOWN_CYCLES = 20
"""So many dropouts in a row make one that is down."""
LINK_OK, LINK_DEGRADED, LINK_DOWN = "OK", "DEGRADED", "DOWN"
HOST_IN_TIME, HOST_MISSED = "In time", "MISSED"


class LabelChange(NamedTuple):
    """``label`` holds from an instant on."""

    at: int
    label: str


class _Codes:
    """Codes of rows, from one call to the next: a change is reported."""

    def __init__(self) -> None:
        self._last = -1

    def _changes(
        self, codes: NDArray[np.int64], instants: NDArray[np.int64], label: Callable[[int], str]
    ) -> list[LabelChange]:
        """``codes``, ``instants``: (n,) of rows in order."""
        changed = np.flatnonzero(np.diff(codes, prepend=self._last))
        if codes.size:
            self._last = int(codes[-1])
        return [LabelChange(int(instants[place]), label(int(codes[place]))) for place in changed]


class DriveStates(_Codes):
    """Changes of one axis' CiA 402 state, by its readings."""

    def changes(self, rows: Rows) -> list[LabelChange]:
        """Return the changes in rows of one axis, in order."""
        read = rows.compress(rows["fate"] == FATE_SAMPLE)
        words = (read["statusword"] & STATE_BITS).astype(np.int64)
        told_at = np.where(read["status_told_at"] == NEVER_TOLD, read["due_at"], read["status_told_at"])
        return self._changes(words, told_at, drive_label)


class LinkStates(_Codes):
    """Quality of one axis' link: DOWN after :data:`LINK_DOWN_CYCLES` dropouts in a row, DEGRADED after any
    within the last :data:`LINK_OK_CYCLES`.

    A cycle without SYNC says nothing about the link.
    """

    def __init__(self) -> None:
        super().__init__()
        self._window: NDArray[np.int64] = np.zeros(LINK_OK_CYCLES, np.int64)

    def changes(self, rows: Rows) -> list[LabelChange]:
        """Return the changes in rows of one axis, in order."""
        rows = rows.compress(rows["fate"] != FATE_MISSED)
        dropped = np.concatenate((self._window, rows["fate"] != FATE_SAMPLE)).astype(np.int64)
        self._window = dropped[-LINK_OK_CYCLES:]
        total = np.cumsum(dropped)
        known = total[LINK_OK_CYCLES:]
        lately = known - total[:-LINK_OK_CYCLES]
        in_a_row = known - total[LINK_OK_CYCLES - LINK_DOWN_CYCLES : -LINK_DOWN_CYCLES]
        levels = (lately > 0).astype(np.int64) + (in_a_row == LINK_DOWN_CYCLES)
        return self._changes(levels, rows["due_at"], (LINK_OK, LINK_DEGRADED, LINK_DOWN).__getitem__)


class HostStates(_Codes):
    """State of the host, by its SYNCs: changes from one cycle to the next."""

    def changes(self, rows: Rows) -> list[LabelChange]:
        """Return the changes in rows of one axis, in order."""
        missed = (rows["fate"] == FATE_MISSED).astype(np.int64)
        return self._changes(missed, rows["due_at"], (HOST_IN_TIME, HOST_MISSED).__getitem__)


class FateStates(_Codes):
    """Fates of the readings of one axis: changes from one cycle to the next."""

    def changes(self, rows: Rows) -> list[LabelChange]:
        """Return the changes in rows of one axis, in order; QUIET: there is a reading."""
        labels = (QUIET, *(cause.value.capitalize() for cause in CAUSES))
        return self._changes(rows["fate"].astype(np.int64), rows["due_at"], labels.__getitem__)


def drive_label(statusword: int) -> str:
    """Return the state's name for a reader."""
    state = state_of(statusword)
    return state.value.capitalize() if state is not None else f"undefined 0x{statusword:02X}"
