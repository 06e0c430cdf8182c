"""Data about its axis for a controller or compensator."""

from dataclasses import dataclass

from servobench.design.motor import PmsmParameters
from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.hil.loop.scenario import Quantity


@dataclass(frozen=True, slots=True)
class Setup:
    """One axis of a bench."""

    axis: str
    period: Duration
    """Period of the loop, ns."""
    motor: PmsmParameters
    torque_max_nm: float
    """Limit of a set-point; values beyond it are clipped."""
    speed_max_rad_s: float
    """At which the bench stops the drive."""
    patience_s: float
    """Limit of one call of a user class by the host's clock, s."""
    source: str
    """The bench file; errors name it."""
    given: Quantity = Quantity.TORQUE
    """Quantity that the drive takes in its mode."""

    followed: Quantity = Quantity.SPEED
    """Quantity of the axis' reference."""

    @property
    def period_s(self) -> float:
        """``period`` in s."""
        return self.period / NS_PER_S
