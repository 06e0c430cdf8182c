"""The device's own clock, as seen in 1013h: starts somewhere, and does not run like the bench's."""

from typing import Final

from drivers.timebase import NS_PER_S, NS_PER_US, Instant

_WRAP: Final = 1 << 32


class DeviceClock:
    """local = offset + elapsed * (1 + drift), elapsed counted from power-on; integers only."""

    __slots__ = ("_drift_ppb", "_first_ns", "_offset_ns", "_started_at")

    def __init__(self, offset_ns: int = 0, drift_ppb: int = 0) -> None:
        """``offset_ns``: what it shows at power-on and after each reset."""
        self._first_ns = offset_ns
        self._offset_ns = offset_ns
        self._drift_ppb = drift_ppb
        self._started_at = Instant(0)

    def start(self, now: Instant) -> None:
        """Power-on or reset of the node: the counter begins anew; its oscillator runs as it did."""
        self._offset_ns = self._first_ns
        self._started_at = now

    def local_ns(self, now: Instant) -> int:
        """What the clock shows at ``now``, ns, not wrapped."""
        elapsed = now - self._started_at
        return self._offset_ns + elapsed + elapsed * self._drift_ppb // NS_PER_S

    def stamp_us(self, now: Instant) -> int:
        """1013h: UNSIGNED32 microseconds, wrapping after 71.6 minutes (CiA 301, 7.5.2.16)."""
        return self.local_ns(now) // NS_PER_US % _WRAP

    def set_us(self, stamp_us: int, now: Instant) -> None:
        """1013h is written: the clock shows ``stamp_us`` at ``now``."""
        self._offset_ns += stamp_us * NS_PER_US - self.local_ns(now)

    def step(self, step_ns: int) -> None:
        """The clock jumps ahead by ``step_ns``, or back."""
        self._offset_ns += step_ns

    def drift_more(self, drift_ppb: int, now: Instant) -> None:
        """From ``now`` on the clock runs faster by ``drift_ppb`` than it did; it does not jump."""
        self._offset_ns = self.local_ns(now)
        self._started_at = now
        self._drift_ppb += drift_ppb
