"""A mode of operation of the drive, and halt: bit 8 of the controlword and 605Dh."""

import math

from mypy_extensions import mypyc_attr

from servobench.drivers.cia402.profile import Control, Status
from servobench.virtual_bus.drive.axis import SimulatedAxis
from servobench.virtual_bus.drive.power_state import MotorAction


@mypyc_attr(allow_interpreted_subclasses=True)
class OperationMode:
    """Actions of the drive in OPERATION_ENABLED while nothing stops it. Override as needed."""

    def __init__(self, axis: SimulatedAxis) -> None:
        self.axis = axis
        self.periodic = True
        """True: the mode runs once per motion period; the others act on their set-points alone."""
        self.has_following_error = False
        """True: bit 13 of the statusword is the following error."""

    def begin(self, controlword: int) -> None:
        """OPERATION_ENABLED begins, or the mode was changed in it; edges count from ``controlword`` on."""

    def receive(self, controlword: int) -> None:
        """Another controlword than the last."""

    def take_torque(self) -> None:
        """6071h or 60B2h was written."""

    def take_velocity(self) -> None:
        """60FFh or 60B1h was written."""

    def take_position(self) -> None:
        """607Ah or 60B0h was written."""

    def take_data_record(self) -> None:
        """60C1h:1 was written."""

    def run(self) -> None:
        """A motion period begins."""

    def status_bits(self) -> int:
        """Statusword bits 10, 12 and 13 of this mode while it is followed."""
        return 0

    def stop_rad_s2(self, motion: MotorAction) -> float:
        """Deceleration of a stop."""
        if motion is MotorAction.CURRENT_LIMIT:
            return math.inf
        return self.quick_stop_rad_s2() if motion is MotorAction.QUICK_STOP_RAMP else self.slow_down_rad_s2()

    def slow_down_rad_s2(self) -> float:
        """Deceleration of the slow down ramp of the option codes (605Ah..605Eh)."""
        return self.axis.deceleration_rad_s2

    def quick_stop_rad_s2(self) -> float:
        """Deceleration of their quick stop ramp."""
        return self.axis.quick_stop_rad_s2


class HaltedMode(OperationMode):
    """A mode that knows a halt: the profile modes and homing."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self.halted = False
        """A halt is commanded."""

    def begin_halt(self, controlword: int) -> None:
        """The mode begins; a halt may be there already."""
        self.halted = False
        self.take_halt(controlword)

    def take_halt(self, controlword: int) -> bool:
        """Begin the stop, or end the halt: true then, and the mode goes on from where the shaft is."""
        asked = controlword & Control.HALT != 0
        if asked == self.halted:
            return False
        self.halted = asked
        if asked:
            slow, quick = self.slow_down_rad_s2(), self.quick_stop_rad_s2()
            self.axis.stop(self.axis.halt_rad_s2(slow, quick))
        return not asked

    def target_bit(self, reached: bool) -> int:
        """Bit 10 of the statusword: the target is ``reached``, or the shaft stands during a halt."""
        return Status.TARGET_REACHED if (self.axis.rests() if self.halted else reached) else 0
