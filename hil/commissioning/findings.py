"""What the steps of a commissioning learn about a drive."""

from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, QuickStopOption
from servobench.drivers.cia402.scaling import ScaleOverride, Scaling
from servobench.drivers.cia402.told_motor import ToldMotor
from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.hil.commissioning.identify import Mechanics, SpeedRatio
from servobench.hil.commissioning.request import MotionLimits
from servobench.hil.configuration.network_file import Network
from servobench.hil.restoring.journal import ObjectKey

MILLISECOND: Final = Duration(NS_PER_MS)


BY_NAMEPLATE: Final = "by the nameplate"


class Stated(NamedTuple):
    """A figure that somebody's word stands for."""

    value: float
    by: str
    """Whose: by the nameplate, as said at the motor, or which object told it."""
    told: bool = False
    """By the drive."""


class DriveRamp(NamedTuple):
    """A ramp or a speed that a drive keeps to by itself."""

    held: str
    """``6083h = 10``."""
    amount: float
    """rad/s^2; of 6087h N m/s, of a speed rad/s."""


@dataclass(slots=True)
class Findings:
    """What the steps learnt; None: not yet, or not to be had."""

    identity: Identity | None = None
    dump: dict[tuple[int, int], bytes] = field(default_factory=dict)
    told: Scaling | None = None
    """By the drive's own objects."""
    override: ScaleOverride = field(default_factory=ScaleOverride)
    """Where they are wrong."""
    units: Scaling | None = None
    """With the override; None: as told."""
    modes: tuple[Mode, ...] = ()
    """Those of the drive in which something can be commanded."""
    plan: PdoPlan | None = None
    period: Duration = MILLISECOND
    limits: MotionLimits | None = None
    mechanics: Mechanics | None = None
    rough: Mechanics | None = None
    """From the pulses: enough to guide an exercise."""
    motor: ToldMotor = field(default_factory=ToldMotor)
    """By objects of the drive's maker."""
    stated: dict[str, Stated] = field(default_factory=dict)
    """What is taken for pole pairs, winding and torque constant, by quantity: nothing here is measured."""
    speed_noise_rad_s: float = 0.0
    """Rms of the velocity 606Ch about the derivative of the position."""
    rated_current_a: float | None = None
    """A rms, as the drive tells it."""
    voltage_constant: tuple[float, float] | None = None
    """V s/rad, a phase's peak, with its expanded uncertainty, k = 2; None unless the voltage gave out."""
    torque_constant_nm_a: float | None = None
    """N m per A rms, as the drive's own figures have it."""
    velocity_ratio: SpeedRatio | None = None
    """Velocity over position derivative, both as told."""
    ramps: dict[Object, DriveRamp] = field(default_factory=dict)
    """Those that the drive obeys in the mode that is set: 6083h, 6087h and so on."""
    ramp_factor: float = 1.0
    """Above 1: so much more than the drive's own unit makes necessary is asked of its ramps."""
    quick_stop_rad_s2: float | None = None
    """6085h as it was found to be needed; None: the drive's own."""
    quick_stop_option: QuickStopOption = QuickStopOption.QUICK_STOP_RAMP
    network: Network | None = None
    reading_delay_us: float | None = None
    effect_delay_us: float | None = None
    command_to_torque_s: float | None = None
    """From a SYNC until the torque of its cycle acts, by the motion: of a drive that tells no torque."""
    torque_lag_us: float | None = None
    current_bandwidth_hz: float | None = None
    """Of the lag of first order that is as far behind a command's arrival in the drive as its torque is."""
    controller: dict[str, Any] = field(default_factory=dict)
    settings: dict[ObjectKey, bytes] = field(default_factory=dict)
    """What the drive was set to for good, not for a step only; known at the end."""
    originals: dict[ObjectKey, bytes] = field(default_factory=dict)
    """What every object held before it was changed; known at the end."""
    versions: dict[str, str] = field(default_factory=dict)
    """1009h and 100Ah, as far as the drive tells them."""

    @property
    def scaling(self) -> Scaling:
        """The units as far as they are known by now: what was found against the drive's objects is
        disbelieved in all that follows from it too."""
        assert self.told is not None, "the step 'units' comes first"
        return self.units or self.told

    def value(self, quantity: str) -> float | None:
        """Of what is stated; None if nobody did."""
        stated = self.stated.get(quantity)
        return None if stated is None else stated.value
