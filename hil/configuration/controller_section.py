"""What every kind of controller says of itself to the checks of a bench."""

from typing import ClassVar

from servobench.hil.configuration.config_files import Section
from servobench.hil.loop.scenario import Quantity


class AxisController(Section):
    """``[drive.NAME.controller]``, of whatever kind; as it stands, a speed loop over torques."""

    gives: ClassVar[tuple[Quantity, ...]] = (Quantity.TORQUE,)
    """Set-points that it can give; a drive takes those of its mode."""

    def follows(self, given: Quantity) -> Quantity | None:  # noqa: ARG002
        """The reference that it takes where the drive is given ``given``; None: any."""
        return Quantity.SPEED
