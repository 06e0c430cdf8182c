"""PV, profile velocity mode (CiA 402-2): to the target velocity by the profile ramps.

Statusword: bit 10 target reached (606Dh, 606Eh), or at rest during a halt; bit 12 speed is zero: no more once
it was above 606Fh for 6070h, and again as soon as it is not. Bit 13, the slippage error of asynchronous
motors, stays 0.
"""

from drivers.cia402.profile import Status
from virtual_bus.drive.axis import SimulatedAxis, WindowTimer
from virtual_bus.drive.operation_mode import HaltedMode
from virtual_bus.drive.trajectory import plan_speed


class ProfileVelocity(HaltedMode):
    """A ramp in speed, planned anew when the target or a rate changes."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self._reached_window = WindowTimer()
        self._turning_window = WindowTimer()
        self._profile = plan_speed(0.0, 0.0, 1.0, 1.0)
        self._elapsed_s = 0.0
        self._planned: tuple[float, float, float] | None = None
        self._reached = False
        self._zero = False

    def begin(self, controlword: int) -> None:
        self.axis.begin()
        self._start_anew()
        self._zero = False
        self._turning_window.restart()
        self._watch()
        self.halt.begin(controlword, self.slow_down_rad_s2())

    def receive(self, controlword: int) -> None:
        if self.halt.receive(controlword, self.slow_down_rad_s2()):
            self._start_anew()

    def run(self) -> None:
        axis = self.axis
        if not self.halt.active:
            self._plan()
            self._elapsed_s += axis.period_s
            axis.run_at(self._profile.at(self._elapsed_s).speed)
            if axis.barred:
                self._start_anew()
        self._watch()

    def status_bits(self) -> int:
        return self.target_bit(self._reached) | (Status.MODE_12 if self._zero else 0)

    # ---- inside ---------------------------------------------------------------------------------------

    def _start_anew(self) -> None:
        """The next plan begins at the speed that the shaft has."""
        self._planned = None
        self._reached = False
        self._reached_window.restart()

    def _plan(self) -> None:
        """Target, inside 607Fh and 6080h, and rates; rad/s, rad/s^2."""
        axis = self.axis
        most = axis.speed_of(axis.motion.max_speed.value)
        wanted = axis.motion.target_velocity.value * axis.units.rad_s_per_velocity
        target = axis.cut_speed(min(max(wanted, -most), most))
        axis.limited = axis.limited or target != wanted
        planned = (target, axis.acceleration_rad_s2, axis.deceleration_rad_s2)
        if planned == self._planned:
            return
        start = axis.speed_rad_s if self._planned is None else self._profile.at(self._elapsed_s).speed
        self._profile = plan_speed(start, *planned)
        self._elapsed_s = 0.0
        self._planned = planned
        self._reached = False
        self._reached_window.restart()

    def _watch(self) -> None:
        axis, motion = self.axis, self.axis.motion
        velocity = axis.velocity
        near = abs(velocity - motion.target_velocity.value) <= motion.velocity_window.value
        self._reached = self._reached_window.held(near, axis.period_s, motion.velocity_ms.value)
        turning = abs(velocity) > motion.threshold.value
        held = self._turning_window.held(turning, axis.period_s, motion.threshold_ms.value)
        self._zero = not turning or (self._zero and not held)
