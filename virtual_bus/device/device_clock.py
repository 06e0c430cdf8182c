"""A device's own clock, and how 1013h tells of it.

    clock     local = offset + elapsed * (1 + drift), elapsed counted from power-on
    latched   the clock at the instant of sampling, of the SYNC's arrival, or of the next inner tick
    told      floor(latched / resolution) * resolution, in units, modulo 2^bits

Devices differ in all of it. CiA 301 (7.5.2.16) asks for microseconds and for nothing else.
"""

from collections.abc import Callable

from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.virtual_bus.device.device_options import StampOptions


class DeviceClock:
    """Starts somewhere, and does not run like the bench's; integers only."""

    __slots__ = (
        "_at_arrival",
        "_at_tick",
        "_drift_ppb",
        "_first_ns",
        "_late_ns",
        "_offset_ns",
        "_resolution_ns",
        "_runs",
        "_started_at",
        "_sync_at",
        "_tick_after",
        "_unit_ns",
        "_wrap",
        "_written",
    )

    def __init__(
        self, offset_ns: int, drift_ppb: int, stamp: StampOptions, tick_after: Callable[[Instant], Instant]
    ) -> None:
        """``offset_ns``: what it shows at power-on and after each reset. ``tick_after``: see
        :class:`servobench.virtual_bus.device.application.Application`."""
        self._first_ns = offset_ns
        self._offset_ns = offset_ns
        self._drift_ppb = drift_ppb
        self._started_at = self._sync_at = Instant(0)
        # At every SYNC: fields of its own are compiled, those of a dataclass are looked up by name.
        self._runs, self._unit_ns, self._resolution_ns = stamp.runs, stamp.unit_ns, stamp.resolution_ns
        self._at_arrival, self._at_tick = stamp.latched == "arrival", stamp.latched == "tick"
        self._late_ns = stamp.late_ns
        self._wrap = 1 << stamp.bits
        self._written = 0
        self._tick_after = tick_after

    def start(self, now: Instant) -> None:
        """Power-on or reset of the node: the counter begins anew; its oscillator runs as it did."""
        self._offset_ns = self._first_ns
        self._started_at = self._sync_at = now
        self._written = 0

    def sync_came(self, at: Instant) -> None:
        """A SYNC frame ended at ``at``."""
        self._sync_at = at

    def local_ns(self, now: Instant) -> int:
        """Return the clock's time at ``now``, ns, not wrapped."""
        elapsed = now - self._started_at
        return self._offset_ns + elapsed + elapsed * self._drift_ppb // NS_PER_S

    def stamp(self, now: Instant) -> int:
        """1013h, UNSIGNED32, as it is told at ``now``."""
        if not self._runs:
            return self._written
        local_ns = self.local_ns(self._latched_at(now))
        return local_ns // self._resolution_ns * self._resolution_ns // self._unit_ns % self._wrap

    def write(self, stamp: int, now: Instant) -> None:
        """1013h is written at ``now``: what was latched last counts as ``stamp``."""
        self._written = stamp
        self._offset_ns += stamp * self._unit_ns - self.local_ns(self._latched_at(now))

    def _latched_at(self, now: Instant) -> Instant:
        at = now
        if self._at_arrival:
            at = self._sync_at
        elif self._at_tick:
            at = self._tick_after(now)
        return Instant(at + self._late_ns)

    def step(self, step_ns: int) -> None:
        """The clock jumps ahead by ``step_ns``, or back."""
        self._offset_ns += step_ns

    def drift_more(self, drift_ppb: int, now: Instant) -> None:
        """From ``now`` on the clock runs faster by ``drift_ppb`` than it did; it does not jump."""
        self._offset_ns = self.local_ns(now)
        self._started_at = now
        self._drift_ppb += drift_ppb
