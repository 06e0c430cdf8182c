"""What a controller or compensator is told of its axis when it is made."""

from dataclasses import dataclass

from servobench.design.motor import PmsmParameters
from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.hil.loop.scenario import Quantity


@dataclass(frozen=True, slots=True)
class Setup:
    """One axis of a bench."""

    axis: str
    period: Duration
    """Of the loop, ns."""
    motor: PmsmParameters
    torque_max_nm: float
    """Of a set-point; what is beyond is cut off."""
    speed_max_rad_s: float
    """At which the bench stops the drive."""
    patience_s: float
    """How long one call of a class of one's own may take by the host's clock, s."""
    source: str
    """The bench file; errors name it."""
    given: Quantity = Quantity.TORQUE
    """What the drive takes in its mode."""

    @property
    def period_s(self) -> float:
        """``period`` in s."""
        return self.period / NS_PER_S
