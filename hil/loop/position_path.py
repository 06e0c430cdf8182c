"""Position set-points that a drive can follow: of limited speed and acceleration."""

import math


class PositionPath:
    """From one set-point to the next, after demands that may jump.

    A demand that keeps the limits itself passes through as it is. After one that does not, the path catches
    up: at the demand's own rate and beside it no faster than it can brake from on the way that is left,

        v + (v - a) + (v - 2 a) + ...  =  n v - a n (n - 1) / 2   (v: rad a period, a: rad a period squared)
    """

    def __init__(self, rate_max_rad_s: float, acceleration_max_rad_s2: float | None, period_s: float) -> None:
        self._period_s = period_s
        self.limit(rate_max_rad_s, acceleration_max_rad_s2)
        self.start_from(0.0)

    def limit(self, rate_max_rad_s: float, acceleration_max_rad_s2: float | None) -> None:
        """Keep these limits from the next set-point on; None: any acceleration."""
        self._step_max = rate_max_rad_s * self._period_s
        acceleration = math.inf if acceleration_max_rad_s2 is None else acceleration_max_rad_s2
        self._change = acceleration * self._period_s**2
        """Largest change of a step."""

    def start_from(self, position_rad: float, rate_rad_s: float = 0.0) -> None:
        """The path begins there, at that speed."""
        self._position = self._demand = position_rad
        self._step = self._moved = self._rate = rate_rad_s * self._period_s

    def towards(self, demand_rad: float) -> float:
        """The next set-point, rad; the last one again for what is not a number."""
        if math.isnan(demand_rad):
            self._step = 0.0
            return self._position
        rate, step = self._rate_of(demand_rad), demand_rad - self._position
        in_reach = abs(step) <= self._step_max and abs(step - self._step) <= self._change
        if in_reach and abs(step - rate) <= self._change:
            self._step = step
            self._position = demand_rad
            return demand_rad
        step = min(max(self._braking(step, rate), -self._step_max), self._step_max)
        self._step = min(max(step, self._step - self._change), self._step + self._change)
        self._position += self._step
        return self._position

    def _rate_of(self, demand_rad: float) -> float:
        """By how much the demand moves in a period; a jump is no movement."""
        moved, self._demand = demand_rad - self._demand, demand_rad
        if abs(moved - self._moved) <= self._change:
            self._rate = moved
        self._moved = moved
        return self._rate

    def _braking(self, step: float, rate: float) -> float:
        """The step from which the path can still come to go with the demand."""
        if math.isinf(self._change):
            return step
        behind, change = step - rate, self._change
        left = max(1, math.ceil(math.sqrt(0.25 + 2.0 * abs(behind) / change) - 0.5))
        return rate + math.copysign(abs(behind) / left + 0.5 * change * (left - 1), behind)
