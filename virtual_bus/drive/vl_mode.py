"""VL, the velocity mode of frequency converters (CiA 402-2): a target in r/min behind a ramp.

    6042h --> 6046h --> bit 6 --> ramp 6048h, 6049h --> bit 5 --> bit 4 --> 6043h --> speed loop
              least and   0: 0    faster, slower        0: held   0: the drive's own, here to rest
              most amount                                         by 6049h

A target of 0 is none below the least amount: the shaft stands. 604Ah is the quick stop ramp of this mode. It
has no bits of its own in the statusword; bit 10 says that the shaft stands during a halt.
"""

from servobench.drivers.cia402.profile import Control
from servobench.virtual_bus.drive.axis import SimulatedAxis
from servobench.virtual_bus.drive.operation_mode import HaltedMode
from servobench.virtual_bus.drive.trajectory import TrajectoryPoint, plan_speed


class VelocityMode(HaltedMode):
    """A ramp in speed, planned anew when its input or a rate changes."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self._profile = plan_speed(TrajectoryPoint(0.0, 0.0), 0.0, 1.0, 1.0)
        self._elapsed_s = 0.0
        self._planned: tuple[float, float, float] | None = None
        self._word = 0

    def begin(self, controlword: int) -> None:
        self.axis.begin()
        self._planned = None
        self._word = controlword
        self.begin_halt(controlword)

    def receive(self, controlword: int) -> None:
        self._word = controlword
        if self.take_halt(controlword):
            self._planned = None

    def run(self) -> None:
        axis = self.axis
        if self.halted:
            return
        locked = self._word & Control.MODE_4 and not self._word & Control.MODE_5
        if not locked or self._planned is None:
            self._plan()
        if not locked:
            self._elapsed_s += axis.period_s
        axis.run_at(self._profile.at(self._elapsed_s).speed)
        if axis.barred:
            self._planned = None

    def status_bits(self) -> int:
        return self.target_bit(False)

    def slow_down_rad_s2(self) -> float:
        return self.axis.ramp_rad_s2(self.axis.motion.vl_deceleration)

    def quick_stop_rad_s2(self) -> float:
        return self.axis.ramp_rad_s2(self.axis.motion.vl_quick_stop)

    # ---- inside ---------------------------------------------------------------------------------------

    def _plan(self) -> None:
        """From the speed that the ramp, or at its begin the shaft, has; rad/s, rad/s^2."""
        axis, motion = self.axis, self.axis.motion
        target = axis.cut_speed(self._input() * axis.rad_s_per_vl)
        planned = (target, axis.ramp_rad_s2(motion.vl_acceleration), self.slow_down_rad_s2())
        if planned == self._planned:
            return
        start = axis.speed_rad_s if self._planned is None else self._profile.at(self._elapsed_s).speed
        self._profile = plan_speed(TrajectoryPoint(0.0, start), *planned)
        self._elapsed_s = 0.0
        self._planned = planned

    def _input(self) -> int:
        """Return the ramp's target, units of the mode; 0 while the controlword blocks it."""
        asked = int(self.axis.motion.vl_target.value)
        if not asked or not self._word & Control.MODE_4 or not self._word & Control.MODE_6:
            return 0
        motion = self.axis.motion
        amount = min(max(abs(asked), int(motion.vl_least.value)), int(motion.vl_most.value))
        self.axis.limited = self.axis.limited or amount != abs(asked)
        return amount if asked > 0 else -amount
