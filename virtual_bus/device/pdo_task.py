"""A task of a device's firmware that looks at its PDOs once a period, and not when a frame ends.

frame ends     |        |  |                 |
ticks        |     |     |     |     |     |     |      from power-on, or from the last SYNC
acted on           |     ||                |            a dead time behind the tick
"""

from servobench.drivers.timebase import Instant


class PdoTask:
    """Tells when what has come is acted on."""

    def __init__(self, period_ns: int, phase_ns: int, dead_ns: int = 0) -> None:
        """``period_ns``: 0: it acts at once, but for ``dead_ns``."""
        self._period_ns, self._phase_ns, self._dead_ns = period_ns, phase_ns, dead_ns
        self._first_at = phase_ns

    def begin(self, at: Instant) -> None:
        """Power-on, or a SYNC: ticks count from there."""
        self._first_at = at + self._phase_ns

    def due(self, now: Instant) -> Instant:
        """The dead time after the next tick, at ``now`` or later."""
        at = int(now)
        if self._period_ns:
            ticks = -((self._first_at - at) // self._period_ns)
            at = self._first_at + ticks * self._period_ns
        return Instant(at + self._dead_ns)


def task_of(period_ns: int, phase_ns: int, dead_ns: int = 0) -> PdoTask | None:
    """Return that task; None if it would act at once."""
    return PdoTask(period_ns, phase_ns, dead_ns) if period_ns or dead_ns else None
