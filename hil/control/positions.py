"""Controllers for a drive that closes more than its current loop: a position loop over its speed mode, and
streams of set-points.

    reference position --> P --+--> speed set-point --> the drive's speed loop --> shaft
    its rate ------------------'
"""

from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.axis_roles import Controller
from servobench.hil.loop.context import Context, PositionSetPoint, SetPoint, SpeedSetPoint, TorqueSetPoint
from servobench.hil.loop.scenario import Quantity


class PositionLoop(Controller):
    """omega_set = K (theta*(t_s) - theta(t_s)) + F omega*(t_a + lead).

    t_s is the instant of the estimate, so a steady speed leaves no error however old the reading is; t_a that
    at which the command acts. ``lead``: what the drive takes from there until its shaft has the speed.
    """

    def __init__(self, gain_per_s: float, feedforward: float, lead: Duration) -> None:
        self._gain_per_s = gain_per_s
        self._feedforward = feedforward
        self._lead = lead

    def output(self, context: Context) -> SetPoint:
        speed = self._feedforward * context.reference_rate_at(Instant(context.acts_at + self._lead))
        estimate = context.estimate
        if estimate.sequence > 0:
            asked_rad = context.reference_at(estimate.valid_at)
            speed += self._gain_per_s * (asked_rad - estimate.position_rad)
        return SpeedSetPoint(speed)


class SetPointStream(Controller):
    """The reference itself, at the instant for which the drive takes a set-point.

    A torque or speed is in force once it acts. A position is reached an interpolation period, 60C2h, later.
    """

    def __init__(self, quantity: Quantity, period: Duration) -> None:
        self._quantity = quantity
        self._period = period

    def output(self, context: Context) -> SetPoint:
        if self._quantity is Quantity.POSITION:
            return PositionSetPoint(context.reference_at(Instant(context.acts_at + self._period)))
        asked = context.reference_at(context.acts_at)
        return SpeedSetPoint(asked) if self._quantity is Quantity.SPEED else TorqueSetPoint(asked)
