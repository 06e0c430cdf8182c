"""Results of commissioning steps, and their findings about a drive."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final, NamedTuple

from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, QuickStopOption
from servobench.drivers.cia402.scaling import ScaleOverride, Scaling
from servobench.drivers.cia402.told_motor import ToldMotor
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.hil.commissioning.excitation import Resonance
from servobench.hil.commissioning.identify import Mechanics, SpeedRatio
from servobench.hil.commissioning.request import MotionLimits
from servobench.hil.configuration.network_file import Network
from servobench.hil.restoring.journal import ObjectKey

LOSSES_MAX: Final = 0.1
"""Part of a step's readings that may be lost. A sound bus loses none, a bad one a hundredth; if a tenth is
missing something beyond the drive is wrong, and the torque is unknown for a tenth of the time."""


class StepFailed(PeerFault):
    """A step failed; it may be repeated, or skipped with a reason."""


class ReadingsLost(PeerFault):
    """Bus or machine were disturbed while a step measured; it says nothing about the drive."""


def refuse_losses(lost: int, cycles: int) -> None:
    """Raise ReadingsLost if more were lost than a figure can tolerate."""
    if lost > LOSSES_MAX * cycles:
        raise ReadingsLost(
            f"{lost} of {cycles} readings were lost",
            f"{100.0 * lost / cycles:.1f} %; at most {100.0 * LOSSES_MAX:g} % may be",
            "look at cable, termination and load of the bus (hil measure) and at the load of this machine, "
            "or give a longer period",
        )


class StepVerdict(Enum):
    """How a step ended."""

    DONE = "done"
    FAILED = "failed"
    SKIPPED = "skipped"
    """The user skipped it, with a reason."""
    LEFT_OUT = "left out"
    """The drive or the limits do not allow it."""
    NOT_DONE = "not done"
    """A dry run, or an early end."""


@dataclass(frozen=True, slots=True)
class StatedFigure:
    """A figure with its unit, as a report states it."""

    name: str
    value: float
    unit: str
    uncertainty: float | None = None
    """Expanded, k = 2; None if unknown."""


@dataclass(slots=True)
class StepOutcome:
    """Findings of a step."""

    lines: list[str] = field(default_factory=list)
    """Sentences for the report."""
    figures: dict[str, Any] = field(default_factory=dict)
    """Figures for programs."""
    faults: list[str] = field(default_factory=list)
    """Faults in the drive's settings, and their remedies."""
    pictures: list[str] = field(default_factory=list)
    """File names of plots, relative to the report."""
    quantities: list[StatedFigure] = field(default_factory=list)

    headline: str = ""
    """Line for the table at the top of the report; default: the first of ``lines``."""

    def measured(self, name: str, value: float, unit: str, uncertainty: float | None = None) -> None:
        """Add a figure for the report's table."""
        self.quantities.append(StatedFigure(name, float(value), unit, uncertainty))

    def say(self, line: str) -> None:
        """Add a sentence."""
        self.lines.append(line)


@dataclass(slots=True)
class StepRecord:
    """One step in the report."""

    name: str
    title: str
    plan: str
    verdict: StepVerdict
    limit: str = ""
    """Its failure limit."""
    reason: str = ""
    outcome: StepOutcome = field(default_factory=StepOutcome)
    attempts: int = 1


MILLISECOND: Final = Duration(NS_PER_MS)


BY_NAMEPLATE: Final = "by the nameplate"


class Stated(NamedTuple):
    """A figure that rests on somebody's statement."""

    value: float
    by: str
    """Source: the nameplate, an answer at the motor, or the object that holds it."""
    told: bool = False
    """True if the drive stated it."""


class DriveRamp(NamedTuple):
    """A ramp or a speed that a drive applies by itself."""

    held: str
    """``6083h = 10``."""
    amount: float
    """rad/s^2; of 6087h N m/s, of a speed rad/s."""


@dataclass(slots=True)
class Findings:
    """Results of the steps; None: not yet, or not available."""

    identity: Identity | None = None
    dump: dict[tuple[int, int], bytes] = field(default_factory=dict)
    told: Scaling | None = None
    """Units by the drive's own objects."""
    override: ScaleOverride = field(default_factory=ScaleOverride)
    """Corrections of them."""
    units: Scaling | None = None
    """Units with the override; None: as stated by the drive."""
    modes: tuple[Mode, ...] = ()
    """Modes of the drive in which something can be commanded."""
    plan: PdoPlan | None = None
    period: Duration = MILLISECOND
    limits: MotionLimits | None = None
    mechanics: Mechanics | None = None
    rough: Mechanics | None = None
    """From the pulses: sufficient to guide an exercise."""
    motor: ToldMotor = field(default_factory=ToldMotor)
    """Data in the maker's objects of the drive."""
    stated: dict[str, Stated] = field(default_factory=dict)
    """Statements used for pole pairs, winding and torque constant, by quantity: nothing here is measured."""
    speed_noise_rad_s: float = 0.0
    """Rms of the velocity 606Ch about the derivative of the position."""
    rated_current_a: float | None = None
    """A rms, by the drive."""
    voltage_constant: tuple[float, float] | None = None
    """V s/rad, a phase's peak, with its expanded uncertainty, k = 2; None unless the voltage limit was
    reached."""
    torque_constant_nm_a: float | None = None
    """N m per A rms, by the drive's own figures."""
    velocity_ratio: SpeedRatio | None = None
    """Velocity over position derivative, both in the drive's units."""
    ramps: dict[Object, DriveRamp] = field(default_factory=dict)
    """Ramps that the drive obeys in the present mode: 6083h, 6087h and so on."""
    ramp_factor: float = 1.0
    """Above 1: factor by which its ramps are raised beyond the drive's own unit."""
    quick_stop_rad_s2: float | None = None
    """The 6085h found necessary; None: the drive's own."""
    quick_stop_option: QuickStopOption = QuickStopOption.QUICK_STOP_RAMP
    resonance: Resonance | None = None
    """Of a coupled load, if the frequency response shows one."""
    network: Network | None = None
    reading_delay_us: float | None = None
    effect_delay_us: float | None = None
    command_to_torque_s: float | None = None
    """From a SYNC until the torque of its cycle acts, by the motion, for a drive that reports no torque."""
    torque_lag_us: float | None = None
    current_bandwidth_hz: float | None = None
    """Bandwidth of the first-order lag as far behind a command's arrival in the drive as its torque is."""
    controller: dict[str, Any] = field(default_factory=dict)
    settings: dict[ObjectKey, bytes] = field(default_factory=dict)
    """Permanent settings of the drive, without those of a step; known at the end."""
    originals: dict[ObjectKey, bytes] = field(default_factory=dict)
    """Former values of every changed object; known at the end."""
    versions: dict[str, str] = field(default_factory=dict)
    """1009h and 100Ah, if available."""

    @property
    def scaling(self) -> Scaling:
        """The units known so far: a finding against the drive's objects also overrides everything derived
        from them."""
        assert self.told is not None, "the step 'units' comes first"
        return self.units or self.told

    def value(self, quantity: str) -> float | None:
        """Return a stated value; None if there is none."""
        stated = self.stated.get(quantity)
        return None if stated is None else stated.value
