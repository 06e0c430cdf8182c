"""A speed controller: PI, with the gains from one bandwidth and the motor's inertia."""

from servobench import Command, Context, Controller, Setup, TorqueSetPoint


class SpeedController(Controller):
    """T = Kp e + integral of Ki e, which stands still while the torque is at its limit."""

    def __init__(self, setup: Setup, bandwidth_rad_s: float = 100.0) -> None:
        """``bandwidth_rad_s``: where the loop crosses over; the delay of the bus limits it."""
        self.period_s = setup.period_s
        self.proportional = setup.motor.inertia_kg_m2 * bandwidth_rad_s  # N m per rad/s
        self.integral = self.proportional * bandwidth_rad_s / 5.0  # N m per rad
        self.reset()

    def reset(self) -> None:
        """Before the first cycle."""
        self.sum_nm = 0.0
        self.error_rad_s = 0.0
        self.wanted_nm = 0.0

    def channels(self) -> tuple[str, ...]:
        """Recorded and drawn beside the bench's own figures."""
        return ("integral_nm",)

    def telemetry(self) -> tuple[float, ...]:
        """In the order of the channels."""
        return (self.sum_nm,)

    def output(self, context: Context) -> TorqueSetPoint:
        """The torque that goes out at once, before the bench's limits."""
        self.error_rad_s = context.reference_rad_s - context.estimate.velocity_rad_s
        self.wanted_nm = self.proportional * self.error_rad_s + self.sum_nm
        return TorqueSetPoint(self.wanted_nm)

    def update(self, context: Context, command: Command) -> None:
        """Afterwards, with the torque that was really sent."""
        if command.torque_nm == self.wanted_nm:
            self.sum_nm += self.integral * self.error_rad_s * self.period_s
