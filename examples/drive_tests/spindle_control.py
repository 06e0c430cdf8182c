"""The product of this project: a speed controller for a spindle."""

from servobench import Command, Context, Controller, SetPoint, TorqueSetPoint


class SpindleController(Controller):
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

    def output(self, context: Context) -> SetPoint:
        """The torque that goes out at once, before the bench's limits."""
        reference_rad_s = context.reference_rad_s
        self._error = reference_rad_s - context.estimate.velocity_rad_s
        self._wanted_nm = self.proportional * self._error + self._sum_nm + self.friction * reference_rad_s
        return TorqueSetPoint(self._wanted_nm)

    def update(self, context: Context, command: Command) -> None:
        """Afterwards, with the torque that was really sent."""
        if command.torque_nm == self._wanted_nm:
            self._sum_nm += self.integral * self._error * self.period_s
