"""Properties of every kind of controller for the checks of a bench."""

from typing import ClassVar, Final

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_US
from servobench.hil.configuration.config_files import Section
from servobench.hil.control.setup import Setup
from servobench.hil.loop.scenario import Quantity

ORDER_MAX: Final = 64
"""States, or entries of a row; a design for a delay of 1.1 ms at 1 kHz has four."""


class AxisController(Section):
    """``[drive.NAME.controller]`` of any kind; by default a speed loop over torques."""

    gives: ClassVar[tuple[Quantity, ...]] = (Quantity.TORQUE,)
    """Set-points that it can give; a drive takes those of its mode."""

    needs_count: ClassVar[bool] = False
    """Position and speed of one SYNC are to travel in one TPDO."""

    def follows(self, given: Quantity) -> tuple[Quantity, ...]:  # noqa: ARG002
        """Return what its reference can be of if the drive is given ``given``, the usual one first."""
        return (Quantity.SPEED,)


def check_period(period_us: int, setup: Setup) -> None:
    """Raise BadInput for a controller of another period than the loop's."""
    if period_us * NS_PER_US != setup.period:
        key = f"drive.{setup.axis}.controller.period_us"
        expected = f"loop.period_us = {setup.period / NS_PER_US:g}"
        raise BadInput(setup.source, key, period_us, expected)
