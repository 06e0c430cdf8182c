"""PT, profile torque mode (CiA 402-2): to the target torque (6071h) by the torque slope (6087h)."""

from typing import Final

from virtual_bus.drive.axis import SimulatedAxis
from virtual_bus.drive.operation_mode import HaltedMode

_WINDOW: Final = 0.01
"""The torque is reached within this share of the rated one."""


class ProfileTorque(HaltedMode):
    """A ramp in torque. A halt brings the shaft to rest, and the ramp begins at no torque again."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self._torque_nm = 0.0
        self._reached = False

    def begin(self, controlword: int) -> None:
        self.axis.begin()
        self._torque_nm = self.axis.torque_demand_nm
        self._reached = False
        self.axis.make_torque(self._torque_nm)
        self.halt.begin(controlword, self.slow_down_rad_s2())

    def receive(self, controlword: int) -> None:
        if self.halt.receive(controlword, self.slow_down_rad_s2()):
            self._torque_nm = 0.0
            self.axis.make_torque(0.0)

    def run(self) -> None:
        axis = self.axis
        if self.halt.active:
            return
        target = axis.objects.target_torque.value * axis.torque_unit_nm
        step = axis.motion.torque_slope.value * axis.torque_unit_nm * axis.period_s
        self._torque_nm += min(max(target - self._torque_nm, -step), step)
        axis.make_torque(self._torque_nm)
        window = _WINDOW * 1000.0 * axis.torque_unit_nm
        self._reached = self._torque_nm == target and abs(axis.torque_nm - target) <= window

    def status_bits(self) -> int:
        return self.target_bit(self._reached)
