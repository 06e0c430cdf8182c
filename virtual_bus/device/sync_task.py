"""When a device acts on a SYNC: at once, as late as its task wakes, or by a cycle locked to the SYNCs.

    SYNC ends     |         |           |        |          |      with the jitter of its producer
    task            |           |         |         |         |    late by 0 to the jitter, drawn for each
    cycle            |         |         |         |         |     a phase behind the filtered SYNC

Drives with a locked cycle and a phase to set: Infranor XtrapulsGem (2006h, a PLL, off while 1006h is 0) and
Lenze ECS (C1122).
"""

from typing import Final

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.device_options import SyncOptions
from servobench.virtual_bus.faults.fault_streams import UniformStream

PHASE_GAIN: Final = 1.0 / 16.0
"""By what part of its error the cycle is moved with each SYNC: a fifth of the spread of a jitter is left."""
PERIOD_GAIN: Final = 1.0 / 512.0
"""The same for its period; damping PHASE_GAIN / (2 sqrt(PERIOD_GAIN)) = 0.7."""


class SyncTask:
    """Tells when each SYNC is acted on; in the order in which they came."""

    def __init__(self, options: SyncOptions, name: str) -> None:
        """``name``: of the stream of its jitter, beside the seed."""
        self._jitter_ns, self._phase_ns = options.jitter_ns, options.phase_ns
        self._draw = UniformStream(options.seed, name)
        self._last_due = Instant(0)
        self._nominal_ns = 0
        self._cycle_at = self._period_ns = 0.0

    def due(self, came_at: Instant, period_ns: int) -> Instant:
        """When the SYNC whose frame ended at ``came_at``, the newest, is acted on. ``period_ns``: of SYNCs,
        1006h; 0: nothing is locked to them."""
        due = came_at
        if self._phase_ns is not None and period_ns:
            due = self._locked(came_at, self._phase_ns, period_ns)
        if self._jitter_ns:
            due = Instant(due + int(self._draw.draw() * (self._jitter_ns + 1)))
        self._last_due = due = max(due, self._last_due)
        return due

    def _locked(self, came_at: Instant, phase_ns: int, nominal_ns: int) -> Instant:
        """A phase behind the filtered SYNC; not before the SYNC itself has come."""
        if nominal_ns != self._nominal_ns:
            self._nominal_ns = nominal_ns
            self._cycle_at, self._period_ns = float(came_at), float(nominal_ns)
        else:
            cycles = round((came_at - self._cycle_at) / self._period_ns)
            expected_at = self._cycle_at + cycles * self._period_ns
            error_ns = came_at - expected_at
            self._cycle_at = expected_at + PHASE_GAIN * error_ns
            self._period_ns += PERIOD_GAIN * error_ns
        return max(came_at, Instant(int(self._cycle_at) + phase_ns))
