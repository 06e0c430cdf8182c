"""What a mode of operation is to the drive."""

from mypy_extensions import mypyc_attr

from virtual_bus.drive.axis import SimulatedAxis


@mypyc_attr(allow_interpreted_subclasses=True)
class OperationMode:
    """What the drive does in OPERATION_ENABLED while nothing stops it. Override what is needed."""

    def __init__(self, axis: SimulatedAxis) -> None:
        self.axis = axis
        self.periodic = True
        """Whether the mode runs once per motion period; the others act on their set-points alone."""
        self.has_following_error = False
        """Whether bit 13 of the statusword is the following error."""

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

    def run(self) -> None:
        """A motion period begins."""

    def status_bits(self) -> int:
        """Statusword bits 10, 12 and 13 of this mode while it is followed."""
        return 0

    def slow_down_rad_s2(self) -> float:
        """Deceleration of the slow down ramp of the option codes (605Ah..605Eh)."""
        return self.axis.deceleration_rad_s2
