"""What a measurement is asked to do."""

from dataclasses import dataclass

from design.motor import PmsmParameters
from drivers.timebase import NS_PER_US, Duration
from virtual_bus.hosting.injection import Faults


@dataclass(frozen=True, slots=True)
class MeasureRequest:
    """A checked command line."""

    bus: str
    nodes: tuple[int, ...]
    cycles: int
    period_us: int
    bitrate_bit_s: int
    enable: bool
    """Enable the drives and have them follow small torques."""
    speed_max_rad_s: float
    """An enabled drive that turns faster is stopped."""
    torque_max_nm: float | None = None
    """Largest torque; None: :data:`hil.measuring.excitation.TORQUE_SHARE` of the rated one."""
    motor: PmsmParameters | None = None
    """Of the drives of a simulated bus."""
    faults: Faults | None = None
    seed: int = 0

    @property
    def period(self) -> Duration:
        """Between two SYNCs."""
        return Duration(self.period_us * NS_PER_US)
