"""Where on the bench's time axis a drive took its sample.

A SYNC leaves the host at ``sent``, the drive samples on receiving it and stamps the
sample with its own clock, the reading arrives at ``received``:

    host    --- sent ------------------------------ received --->
                   \\ SYNC                          / TPDO
    drive   ---------- sampled (device stamp) -----------------> other origin, other rate

So each exchange bounds the offset between the clocks: sent < sampled < received. The
lower bound is the tight one: a SYNC of known length goes out first in its cycle.
"""

from collections import deque
from typing import Final

from drivers.timebase import Duration, Instant

BLOCK: Final = 64
"""Exchanges of which the tightest one enters the fit."""
BLOCKS_KEPT: Final = 32
DRIFT_MAX_PPM: Final = 500.0
"""Fastest drift between two quartz clocks that is believed."""


class _Bound:
    """What one exchange says of host minus device: at least ``lower_ns``, at most ``upper_ns``."""

    __slots__ = ("device_ns", "lower_ns", "upper_ns")

    def __init__(self, device_ns: int, lower_ns: int, upper_ns: int) -> None:
        self.device_ns = device_ns
        self.lower_ns = lower_ns
        self.upper_ns = upper_ns


class ClockMap:
    """Offset and rate of one drive's clock against the host's.

    Of every :data:`BLOCK` exchanges the largest lower bound is kept (the SYNC that
    waited least); a straight line through the last :data:`BLOCKS_KEPT` of them is
    the map. Until two blocks are full the rates are taken as equal.
    """

    def __init__(self, sync_latency: Duration) -> None:
        """``sync_latency``: from handing a SYNC over until its end on an idle bus."""
        self._sync_latency = sync_latency
        self._blocks: deque[_Bound] = deque(maxlen=BLOCKS_KEPT)
        self._best: _Bound | None = None
        self._upper_ns = 0
        self._count = 0
        self._origin_ns = 0
        self._offset_ns = 0
        self._rate = 0.0
        self._width_ns = 0

    @property
    def ready(self) -> bool:
        """Whether at least one exchange has been seen."""
        return self._best is not None or bool(self._blocks)

    @property
    def drift_ppm(self) -> float:
        """How much the drive's clock runs slow against the host's (negative: fast), parts per million."""
        return self._rate * 1e6

    def observe(self, sent: Instant, device_ns: int, received: Instant) -> None:
        """Learn from an exchange whose SYNC is known without doubt."""
        lower = sent - device_ns
        upper = received - device_ns
        best = self._best
        if best is None:
            self._best = _Bound(device_ns, lower, upper)
            self._upper_ns = upper
        elif lower > best.lower_ns + self._rate * (device_ns - best.device_ns):
            self._best = _Bound(device_ns, lower, upper)
        if upper < self._upper_ns:
            self._upper_ns = upper
        self._count += 1
        if self._count == BLOCK or not self._blocks:
            self._refit()
        if self._count == BLOCK:
            self._count = 0
            self._best = None

    def place(self, device_ns: int) -> tuple[Instant, int]:
        """The host instant of a device stamp, and half the width of the interval that certainly holds it, ns.

        Needs ``ready``.
        """
        offset = self._offset_ns + round(self._rate * (device_ns - self._origin_ns))
        return Instant(device_ns + offset + self._sync_latency), self._width_ns

    def _refit(self) -> None:
        best = self._best
        assert best is not None
        if self._count == BLOCK:
            self._blocks.append(_Bound(best.device_ns, best.lower_ns, self._upper_ns))
        points = list(self._blocks) or [best]
        self._origin_ns = points[-1].device_ns
        self._rate = _slope(points)
        self._offset_ns = points[-1].lower_ns + round(_residual(points, self._rate))
        self._width_ns = max(0, points[-1].upper_ns - self._offset_ns - self._sync_latency)


def _slope(points: list[_Bound]) -> float:
    """Least-squares rate through the bounds, limited to what two quartz clocks can do."""
    if len(points) < 2:
        return 0.0
    origin, base = points[-1].device_ns, points[-1].lower_ns
    x = [float(point.device_ns - origin) for point in points]
    y = [float(point.lower_ns - base) for point in points]
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    spread = sum((value - mean_x) ** 2 for value in x)
    slope = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / spread
    limit = DRIFT_MAX_PPM * 1e-6
    return min(max(slope, -limit), limit)


def _residual(points: list[_Bound], rate: float) -> float:
    """Mean distance of the bounds from a line of that rate through the last one, ns."""
    last = points[-1]
    offsets = (point.lower_ns - last.lower_ns - rate * (point.device_ns - last.device_ns) for point in points)
    return sum(offsets) / len(points)
