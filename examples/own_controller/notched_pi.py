"""A speed controller for a shaft with a resonance: PI, and a notch where both masses swing."""

import math

from servobench import Command, Context, Controller, Setup, TorqueSetPoint


class NotchedPi(Controller):
    """PI on the speed error, through (s^2 + 2 z0 w s + w^2) / (s^2 + 2 z1 w s + w^2), by Tustin's rule.

    `hil motor show` tells w. The integral stands still while the torque is at its limit.
    """

    def __init__(
        self,
        setup: Setup,
        bandwidth_rad_s: float = 60.0,
        notch_hz: float | None = None,
        depth: float = 0.2,
        width: float = 0.8,
        friction_nm_s: float = 0.0,
    ) -> None:
        """``notch_hz``: by default the resonance of the coupling in the motor's file. ``width`` is z1,
        ``depth`` is z0/z1; ``friction_nm_s``: what a speed takes to hold, N m s/rad."""
        if notch_hz is None:
            mechanism = setup.motor.mechanism
            if mechanism is None or mechanism.coupling is None:
                raise ValueError("notch_hz: expected, as the motor's file has no [coupling]")
            notch_hz = mechanism.coupling.resonance_hz
        self.period_s = setup.period_s
        self.friction_nm_s = friction_nm_s
        self.proportional = setup.motor.inertia_kg_m2 * bandwidth_rad_s  # N m s/rad
        self.integral = self.proportional * bandwidth_rad_s / 5.0  # N m/rad
        notch_rad_s = math.tau * notch_hz
        k = notch_rad_s / math.tan(0.5 * notch_rad_s * self.period_s)  # Tustin's, true at the notch
        square, damping = k * k + notch_rad_s**2, 2.0 * width * notch_rad_s * k
        middle = 2.0 * (notch_rad_s**2 - k * k) / (square + damping)
        self.b = (
            (square + depth * damping) / (square + damping),
            middle,
            (square - depth * damping) / (square + damping),
        )
        self.a = (middle, (square - damping) / (square + damping))
        self.reset()

    def reset(self) -> None:
        """Before the first cycle."""
        self.sum_nm = self.error_rad_s = self.wanted_nm = 0.0
        self.delayed = (0.0, 0.0)

    def output(self, context: Context) -> TorqueSetPoint:
        """The torque that goes out at once, before the bench's limits."""
        self.error_rad_s = context.reference_rad_s - context.estimate.velocity_rad_s
        through = self.b[0] * self.error_rad_s + self.delayed[0]
        feed_nm = self.friction_nm_s * context.reference_rad_s
        self.wanted_nm = self.proportional * through + self.sum_nm + feed_nm
        return TorqueSetPoint(self.wanted_nm)

    def update(self, context: Context, command: Command) -> None:
        """Afterwards, with the torque that was really sent."""
        error = self.error_rad_s
        through = self.b[0] * error + self.delayed[0]
        self.delayed = (
            self.b[1] * error - self.a[0] * through + self.delayed[1],
            self.b[2] * error - self.a[1] * through,
        )
        if command.torque_nm == self.wanted_nm:
            self.sum_nm += self.integral * error * self.period_s
