"""Properties of every kind of controller for the checks of a bench."""

from typing import ClassVar

from servobench.hil.configuration.config_files import Section
from servobench.hil.loop.scenario import Quantity


class AxisController(Section):
    """``[drive.NAME.controller]`` of any kind; by default a speed loop over torques."""

    gives: ClassVar[tuple[Quantity, ...]] = (Quantity.TORQUE,)
    """Set-points that it can give; a drive takes those of its mode."""

    needs_count: ClassVar[bool] = False
    """Position and speed of one SYNC are to travel in one TPDO."""

    def follows(self, given: Quantity) -> Quantity | None:  # noqa: ARG002
        """Return the reference that it takes if the drive is given ``given``; None: any."""
        return Quantity.SPEED
