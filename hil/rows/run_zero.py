"""The run's time zero as a reader of events comes to know it."""

from collections.abc import Sequence

from servobench.drivers.timebase import Instant
from servobench.hil.rows.side_rows import BeginEvent, RunEvent


class RunZero:
    """The instant of the first cycle on the bench clock: all times of a recording count from it."""

    def __init__(self, started_at: Instant) -> None:
        """``started_at``: of the recording; it stands in for a first cycle that never came."""
        self.at = started_at
        self.told = False

    def look(self, events: Sequence[RunEvent]) -> bool:
        """Whether one of ``events`` is the first cycle."""
        for event in events:
            if isinstance(event, BeginEvent):
                self.at, self.told = event.at, True
                return True
        return False
