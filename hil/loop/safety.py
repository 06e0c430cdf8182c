"""Host limits in front of every command.

They are the bench's own, beside whatever the drive is configured to refuse. A
command is cut to its limits; a drive that leaves its limits stops the run.
"""

import math
from dataclasses import dataclass

from hil.loop.samples import StateEstimate


@dataclass(frozen=True, slots=True)
class SafetyLimits:
    """What one axis may do."""

    torque_max_nm: float
    speed_max_rad_s: float
    torque_slew_max_nm_s: float | None = None
    dropouts_consecutive_max: int = 100


class SafetyGuard:
    """Applies :class:`SafetyLimits` to one axis."""

    def __init__(self, limits: SafetyLimits, period_s: float) -> None:
        self._torque_max_nm = limits.torque_max_nm
        self._speed_max_rad_s = limits.speed_max_rad_s
        slew = limits.torque_slew_max_nm_s
        self._torque_step_max_nm = float("inf") if slew is None else slew * period_s
        self._dropouts_max = limits.dropouts_consecutive_max
        self._torque_nm = 0.0
        self._dropouts = 0

    def limit(self, torque_nm: float) -> float:
        """The torque that may be sent, N m; zero for what is not a number."""
        if math.isnan(torque_nm):
            return 0.0
        low = max(-self._torque_max_nm, self._torque_nm - self._torque_step_max_nm)
        high = min(self._torque_max_nm, self._torque_nm + self._torque_step_max_nm)
        self._torque_nm = min(max(torque_nm, low), high)
        return self._torque_nm

    def check_speed(self, velocity_rad_s: float) -> str | None:
        """Why the run must stop after a reading of this speed, or None."""
        if abs(velocity_rad_s) <= self._speed_max_rad_s:
            return None
        return f"speed {velocity_rad_s:.1f} rad/s is beyond the limit of {self._speed_max_rad_s:.1f} rad/s"

    def check_cycle(self, fresh: bool, demand_nm: float, estimate: StateEstimate) -> str | None:
        """Why the run must stop after this cycle, or None.

        ``fresh``: a new sample came since the last cycle.
        """
        reason = self._count(fresh)
        if reason is not None:
            return reason
        if math.isnan(demand_nm):
            return f"the controller's torque is not a number (speed estimate {estimate.velocity_rad_s} rad/s)"
        return None

    def miss_cycle(self) -> str | None:
        """Why the run must stop after a cycle without SYNC, or None."""
        return self._count(False)

    def _count(self, fresh: bool) -> str | None:
        self._dropouts = 0 if fresh else self._dropouts + 1
        if self._dropouts > self._dropouts_max:
            return f"no usable reading for {self._dropouts} cycles (limit {self._dropouts_max})"
        return None
