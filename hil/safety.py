"""Host limits in front of every command.

They are the bench's own, beside whatever the drive is configured to refuse. A
command is cut to its limits; a drive that leaves its limits stops the run.
"""

import math
from dataclasses import dataclass

from drivers.exchange import Reading
from hil.samples import StateEstimate

STATUS_FAULT = 0x0008
"""Statusword bit 3 (CiA 402-2, 0x6041): the drive is in a fault state."""
STATUS_STATE_MASK = 0x006F
STATUS_OPERATION_ENABLED = 0x0027
"""Statusword masked with 0x006F in the state Operation enabled (CiA 402-2, table of states)."""


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

    def check_reading(self, reading: Reading) -> str | None:
        """Why the run must stop after this reading, or None."""
        if abs(reading.velocity_rad_s) > self._speed_max_rad_s:
            found, limit = reading.velocity_rad_s, self._speed_max_rad_s
            return f"speed {found:.1f} rad/s is beyond the limit of {limit:.1f} rad/s"
        if reading.statusword & STATUS_FAULT:
            return f"the drive reports a fault (statusword 0x{reading.statusword:04X})"
        if reading.statusword & STATUS_STATE_MASK != STATUS_OPERATION_ENABLED:
            return f"the drive left Operation enabled by itself (statusword 0x{reading.statusword:04X})"
        return None

    def check_cycle(self, fresh: bool, demand_nm: float, estimate: StateEstimate) -> str | None:
        """Why the run must stop after this cycle, or None.

        ``fresh``: a new sample came since the last cycle.
        """
        self._dropouts = 0 if fresh else self._dropouts + 1
        if self._dropouts > self._dropouts_max:
            return f"no usable reading for {self._dropouts} cycles (limit {self._dropouts_max})"
        if math.isnan(demand_nm):
            return f"the controller's torque is not a number (speed estimate {estimate.velocity_rad_s} rad/s)"
        return None
