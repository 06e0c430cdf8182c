"""References and loads as they take effect, by the rows of the cycles."""

import numpy as np

from servobench.drivers.timebase import Instant
from servobench.hil.loop.cycle_record import NOTHING
from servobench.hil.rows.recording_plan import PlannedSetPoint
from servobench.hil.rows.records import Rows
from servobench.hil.rows.side_rows import TextEvent


class SetPointTeller:
    """Reports a set-point with the first command sent at its time or later.

    A run that ended before never reports it.
    """

    def __init__(self, planned: tuple[PlannedSetPoint, ...]) -> None:
        """``planned``: in order of time."""
        self._planned = planned

    def take(self, rows: Rows, zero: Instant) -> list[TextEvent]:
        """Return the set-points that ``rows``, (n,) of ROW_DTYPE, acted upon; ``zero``: the first cycle."""
        if not self._planned or not rows.size:
            return []
        sent = rows[rows["command_handed_at"] != NOTHING]
        told: list[tuple[int, int, TextEvent]] = []
        waiting: list[PlannedSetPoint] = []
        for each in self._planned:
            acted = np.flatnonzero((sent["axis"] == each.axis) & (sent["due_at"] >= zero + each.after))
            if acted.size:
                at = Instant(int(sent["command_handed_at"][acted[0]]))
                told.append((at, each.axis, TextEvent(at, "INFO", each.text)))
            else:
                waiting.append(each)
        self._planned = tuple(waiting)
        # Of one instant by axis, as the rows come: also where those of one cycle are taken in two parts.
        return [event for _, _, event in sorted(told, key=lambda entry: entry[:2])]
