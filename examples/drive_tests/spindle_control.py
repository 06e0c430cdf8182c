"""The product of this project: a speed controller for a spindle."""

from drivers.exchange import Command
from hil.loop.samples import StateEstimate


class SpindleController:
    """PI with friction feed-forward. The integral stops while the torque is at its limit."""

    def __init__(self, proportional: float, integral: float, friction: float, period_s: float) -> None:
        """N m per rad/s, N m per rad, N m per rad/s."""
        self.proportional = proportional
        self.integral = integral
        self.friction = friction
        self.period_s = period_s
        self._sum_nm = 0.0
        self._error = 0.0
        self._wanted_nm = 0.0

    def output(self, estimate: StateEstimate, reference_rad_s: float) -> float:
        """The torque that goes out at once, N m, before the bench's limits."""
        self._error = reference_rad_s - estimate.velocity_rad_s
        self._wanted_nm = self.proportional * self._error + self._sum_nm + self.friction * reference_rad_s
        return self._wanted_nm

    def update(self, estimate: StateEstimate, command: Command) -> None:
        """Afterwards, with the torque that was really sent."""
        if command.torque_nm == self._wanted_nm:
            self._sum_nm += self.integral * self._error * self.period_s
