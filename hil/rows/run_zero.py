"""Finds the run's time zero from its events."""

from collections.abc import Sequence

from servobench.drivers.timebase import Instant
from servobench.hil.rows.side_rows import BeginEvent, RunEvent


class RunZero:
    """The instant of the first cycle on the bench clock: origin of all times of a recording."""

    def __init__(self, started_at: Instant) -> None:
        """``started_at``: of the recording; used if no first cycle ever came."""
        self.at = started_at
        self.told = False

    def look(self, events: Sequence[RunEvent]) -> bool:
        """Return True if one of ``events`` is the first cycle."""
        for event in events:
            if isinstance(event, BeginEvent):
                self.at, self.told = event.at, True
                return True
        return False
