"""The user's request and permissions, and the laboratory that asks."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from pydantic import Field

from servobench.design.data_sheet import readings
from servobench.design.motor import CONVENTIONS
from servobench.design.sheet_figures import Contradiction, SheetFigures
from servobench.drivers.bounded_file import NamedBy, read_toml
from servobench.drivers.canopen.objects301 import FIRST_OBJECT
from servobench.drivers.errors import BadInput, printable
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.vendors.motor_objects import POLE_PAIRS_MAX
from servobench.hil.configuration.config import Foreign, Guard
from servobench.hil.configuration.config_files import Section, load_file, other_kind, validated
from servobench.hil.configuration.motor_file import LING2012, MotorFile
from servobench.hil.configuration.quantities import (
    Current,
    Inductance,
    Inertia,
    Resistance,
    Speed,
    Torque,
    Voltage,
)
from servobench.hil.restoring.journal import restore_command


class Laboratory(Section):
    """``--lab FILE``: who commissions, and where."""

    operator: str | None = None
    """Name of the operator."""
    site: str | None = None
    """Place and test stand."""
    order: str | None = None
    """Number of the order or of the device under test."""


def load_laboratory(path: Path | None, operator: str | None, site: str | None) -> Laboratory:
    """Return the file's content; ``operator`` and ``site`` go before it. Raises BadInput or BadInputs."""
    found = Laboratory()
    if path is not None:
        found = load_file(Laboratory, path, "a file of --lab", NamedBy("--lab", "", str(path)))
    given = {"operator": operator, "site": site}
    return found.model_copy(update={key: text for key, text in given.items() if text is not None})


class PlateMotor(Section):
    """``[motor]``: known data of the motor itself; all optional.

    Resistance and inductances are of one phase of a star. The constants of the flux are named as in
    :data:`servobench.design.motor.CONVENTIONS`; with one of them the torque has a second witness.
    """

    name: str = "motor"
    resistance_ohm: Resistance | None = None
    inductance_d_h: Inductance | None = None
    inductance_q_h: Inductance | None = None
    pole_pairs: int | None = Field(default=None, gt=0, le=POLE_PAIRS_MAX)
    inertia_kg_m2: Inertia | None = None
    """Inertia of the rotor, without load."""
    kt_nm_arms: float | None = Field(default=None, gt=0)
    kt_nm_apk: float | None = Field(default=None, gt=0)
    kt_nm_adc: float | None = Field(default=None, gt=0)
    ke_line_vrms_krpm: float | None = Field(default=None, gt=0)
    ke_line_vpk_krpm: float | None = Field(default=None, gt=0)
    ke_phase_vrms_krpm: float | None = Field(default=None, gt=0)
    ke_phase_vpk_krpm: float | None = Field(default=None, gt=0)
    kv_rpm_vdc: float | None = Field(default=None, gt=0)
    kv_rpm_vpk: float | None = Field(default=None, gt=0)


class PlateRating(Section):
    """``[rating]``: ratings printed on the motor; all optional."""

    torque_nm: Torque | None = None
    speed_rpm: Speed | None = None
    current_a: Current | None = None
    """Rms, as 0x6075 is."""
    current_max_a: Current | None = None
    dc_bus_voltage_v: Voltage | None = None


class PlateEncoder(Section):
    """``[encoder]``"""

    counts_per_revolution: int | None = Field(default=None, ge=4, le=2**32 - 1)


class PlateLimits(Section):
    """``[limits]``: bounds of commissioning; each has a cautious default."""

    speed_max_rpm: Speed | None = None
    """Default: half of the rated speed."""
    torque_max_percent: float = Field(default=50.0, gt=0, le=300)
    """Share of the rated torque."""
    power_max_w: float | None = Field(default=None, gt=0)
    """Default: rated torque times the speed limit."""
    energy_max_j: float | None = Field(default=None, gt=0)
    """Mechanical work in one step; default: three seconds of the power limit."""
    turns_max: float | None = Field(default=None, gt=0)
    """Travel of the shaft to either side of its start; absent: unlimited."""
    following_error_max_turns: float = Field(default=0.5, gt=0)
    temperature_max_c: float = Field(default=80.0, gt=0)


class PlateTemperature(Section):
    """``[temperature]``: the drive's own object for it, as the profile has none."""

    index: int = Field(ge=FIRST_OBJECT, le=0xFFFF, description="the object's index")
    sub: int = Field(default=0, ge=0, le=255)
    celsius: float = Field(default=1.0, gt=0)
    """Degrees of one raw unit."""


class Nameplate(Section):
    """A nameplate file: data read from motor and machine before anything moves."""

    motor: PlateMotor = PlateMotor()
    rating: PlateRating = PlateRating()
    encoder: PlateEncoder = PlateEncoder()
    limits: PlateLimits = PlateLimits()
    temperature: PlateTemperature | None = None

    @property
    def figures(self) -> SheetFigures:
        """Its motor figures, for comparison with each other."""
        motor, rating = self.motor, self.rating
        return SheetFigures(
            rated_torque_nm=rating.torque_nm,
            rated_speed_rad_s=_times(rating.speed_rpm, RAD_S_PER_RPM),
            rated_current_a=_times(rating.current_a, math.sqrt(2.0)),
            peak_current_a=_times(rating.current_max_a, math.sqrt(2.0)),
            dc_bus_voltage_v=rating.dc_bus_voltage_v,
            pole_pairs=motor.pole_pairs,
            resistance_ohm=motor.resistance_ohm,
            inductance_d_h=motor.inductance_d_h,
            inductance_q_h=motor.inductance_q_h,
            flux={name: value for name in CONVENTIONS if (value := getattr(motor, name)) is not None},
            inertia_kg_m2=motor.inertia_kg_m2,
        )


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


_KEYS: Final = {
    "rated_torque_nm": "rating.torque_nm",
    "rated_speed_rad_s": "rating.speed_rpm",
    "rated_current_a": "rating.current_a",
    "peak_current_a": "rating.current_max_a",
    "dc_bus_voltage_v": "rating.dc_bus_voltage_v",
}
"""Keys in a nameplate file for fields of SheetFigures; all others are ``motor`` plus the name."""
_READINGS_SHOWN: Final = 3
"""More would not help to find the right one."""


@dataclass(eq=False)
class ImpossiblePlate(BadInput):
    """A nameplate whose figures cannot belong to one motor, whatever the drive states."""

    def __str__(self) -> str:
        return printable(f"{self.source}: {self.key}: {self.value}; {self.expected}")


def load_nameplate(path: Path) -> Nameplate:
    """Load the nameplate in the file at ``path``. Raises BadInput or BadInputs; ImpossiblePlate for one that
    contradicts itself."""
    tables = read_toml(path, "nameplate file", NamedBy("--motor", "", str(path)))
    if other := other_kind(tables):
        expected = "a nameplate file, with figures of [motor], [rating], [encoder], [limits]"
        raise BadInput(str(path), "", f"a {other}", expected, "hil docs commissioning shows one")
    plate = validated(Nameplate, tables, str(path))
    refuse_impossible(plate, str(path))
    return plate


def refuse_impossible(plate: Nameplate, source: str) -> None:
    """Raise ImpossiblePlate for figures that cannot belong to one motor."""
    figures = plate.figures
    contradiction = next(figures.contradictions(), None)  # the others follow from it most often
    if contradiction is not None:
        keys = ", ".join(plate_keys(contradiction, figures))
        raise ImpossiblePlate(source, keys, str(contradiction), in_which_they_agree(figures))


def plate_keys(contradiction: Contradiction, figures: SheetFigures) -> list[str]:
    """Return the keys in the file that a contradiction concerns, as far as given."""
    keys = []
    for name in contradiction.fields:
        if name == "flux":
            keys += [f"motor.{each}" for each in figures.flux]
        elif getattr(figures, name) is not None:
            keys.append(_KEYS.get(name, f"motor.{name}"))
    return keys


def in_which_they_agree(figures: SheetFigures) -> str:
    """Name the slips that would explain contradictory figures."""
    agreeing = readings(figures)[:_READINGS_SHOWN]
    if not agreeing:
        return (
            "no unit or convention explains it: one of them is misread, or another motor's; look at the plate"
        )
    return f"they agree if it is {', or '.join(agreeing)}: look at the motor's plate"


_RUN_UP_S: Final = 0.1
"""From rest to the speed limit: a speed set-point rises no faster."""
_UNWATCHED_SPEED: Final = 0.2
"""A shaft that is left alone has 4 % of the energy that it had at the limit."""
_UNWATCHED_TORQUE: Final = 0.5
"""It takes twice as long to run away, and is still above the friction of a motor, which is below a tenth of
its rated torque."""
_UNWATCHED_TURNS: Final = 3.0
"""Each way: no step turns the shaft one way for long, and 607Dh stops drives that obey it."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """The simulated drive on the bus ``simulated``: that of a data sheet on its motor, or that of a seed."""

    seed: int | None = None
    eds: Path | None = None
    motor: MotorFile = LING2012
    """Used with ``eds``; a seed draws its own."""


@dataclass(frozen=True, slots=True)
class CommissionRequest:
    """One commissioning."""

    bus: str
    node: int
    out: Path
    eds: Path | None = None
    nameplate: Nameplate = field(default_factory=Nameplate)
    bitrate_bit_s: int = 1_000_000
    period_us: int | None = None
    """None: 1 ms, or longer if the bus has no room."""
    dry_run: bool = False
    store: bool = False
    trust_nameplate: bool = False
    """Trust the nameplate when unattended, even if the drive contradicts it by far."""
    heartbeat_timeout_ms: int = 150
    """Longest silence that the host tolerates from the drive, and the drive from the host."""
    rehearsal: Rehearsal | None = None
    """None: the drive is on the bus."""
    unwatched: bool = False
    """Accept a drive that has neither 1016h nor node guarding: within the limits of :func:`cautious`."""
    allow: tuple[Foreign, ...] = Guard().allow
    """Frames that others may send, as in ``[guard]`` of a bench."""
    laboratory: Laboratory = field(default_factory=Laboratory)
    """The laboratory that the certificate names."""
    purpose: str = "commissioning"
    """The work in a word, for report and recording."""

    @property
    def brief(self) -> bool:
        """True for a single motion: it is asked before that alone, and leaves a report without the files of a
        commissioning."""
        return self.purpose != "commissioning"

    @property
    def heartbeat_ms(self) -> int:
        """Period of both heartbeats: three fit into the time-out."""
        return max(1, self.heartbeat_timeout_ms // 3)

    @property
    def journal(self) -> Path:
        """The file that records changes."""
        return self.out / "journal.jsonl"

    @property
    def restore_command(self) -> str:
        """The command that undoes everything in the journal."""
        return restore_command(self.journal)


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """The host's limits, in SI units at the motor shaft."""

    torque_nm: float
    torque_slew_nm_s: float
    speed_rad_s: float
    power_w: float
    energy_j: float
    acceleration_rad_s2: float
    """Limit of a speed set-point's rise and fall."""
    travel_rad: float
    """To either side of the shaft's start; infinite: unlimited."""
    following_rad: float


def motion_limits(plate: Nameplate, rated_torque_nm: float, drive_speed_rpm: float | None) -> MotionLimits:
    """Return limits from the nameplate, else from the drive."""
    given = plate.limits
    rated_rpm = plate.rating.speed_rpm or drive_speed_rpm or 1000.0
    speed = (given.speed_max_rpm or 0.5 * rated_rpm) * RAD_S_PER_RPM
    torque = given.torque_max_percent / 100.0 * rated_torque_nm
    power = given.power_max_w or rated_torque_nm * speed
    return MotionLimits(
        torque_nm=torque,
        torque_slew_nm_s=rated_torque_nm / 0.02,
        speed_rad_s=speed,
        power_w=power,
        energy_j=given.energy_max_j or 3.0 * power,
        acceleration_rad_s2=speed / _RUN_UP_S,
        travel_rad=math.inf if given.turns_max is None else given.turns_max * math.tau,
        following_rad=given.following_error_max_turns * math.tau,
    )


def cautious(limits: MotionLimits) -> MotionLimits:
    """Reduce the limits for a drive that continues its last command when its host is gone: the person at its
    emergency stop needs time, and its motion until then must do no harm."""
    return replace(
        limits,
        torque_nm=_UNWATCHED_TORQUE * limits.torque_nm,
        speed_rad_s=_UNWATCHED_SPEED * limits.speed_rad_s,
        acceleration_rad_s2=_UNWATCHED_SPEED * limits.acceleration_rad_s2,
        travel_rad=min(_UNWATCHED_TURNS * math.tau, limits.travel_rad),
    )
