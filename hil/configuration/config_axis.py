"""``[drive.NAME]`` of a bench file: a drive, its mode, limits and controller, and ``observe``: objects
that it sends with the SYNCs, for the recording alone.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field, field_validator

from servobench.drivers.canopen.objects301 import STRUCT_CODES, DataType, object_name
from servobench.drivers.canopen.pdo import SYNCHRONOUS_MAX, PdoEntry
from servobench.drivers.cia402.drive_setup import NUMBERS, Observed
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.sheets.eds.types import standard_type, type_by_name
from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.controller_files import CurrentControl
from servobench.hil.configuration.controller_kinds import (
    ArrivalCompensator,
    CompensatorSection,
    ControllerSection,
)
from servobench.hil.configuration.drive_file import DriveFile
from servobench.hil.configuration.drive_model import DriveModel
from servobench.hil.configuration.motor_file import MotorFile
from servobench.hil.configuration.quantities import (
    DropoutsInARow,
    HeartbeatTimeout,
    SlewRate,
    Speed,
    Torque,
)
from servobench.hil.loop.scenario import QUANTITY_BY_MODE, Quantity
from servobench.virtual_bus.device.device_options import STAMP_BITS, STAMP_LATE_MAX_NS, StampLatch
from servobench.virtual_bus.drive.current_controller import current_bandwidth_hz
from servobench.virtual_bus.drive.lacks import PATTERN

_OBJECT: Final = re.compile(r"([0-9A-Fa-f]{4})(?::([0-9]{1,3}))?")
_OF_THE_LOOP: Final = frozenset(
    {
        Object.STATUSWORD,
        Object.POSITION_ACTUAL_VALUE,
        Object.VELOCITY_ACTUAL_VALUE,
        Object.TORQUE_ACTUAL_VALUE,
        Object.TORQUE_DEMAND,
    }
)
TypeName = Literal[
    "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "real32", "real64"
]


class _Standard(NamedTuple):
    """The CiA 402-2 definition of an object."""

    name: str = ""
    factor: float = 1.0
    unit: str = ""


_STANDARDS: Final[dict[int, _Standard]] = {
    Object.CURRENT_ACTUAL_VALUE: _Standard("current", 0.1, "% of rated"),
    Object.DC_LINK_CIRCUIT_VOLTAGE: _Standard("DC link voltage", 1e-3, "V"),
}
ENTRIES_MAX: Final = 8 * len(NUMBERS)
"""Most entries that the PDOs hold, at a byte each."""


class ObservedObject(Section):
    """One observed object; ``"6078"`` is short for ``{ object = "6078" }``."""

    object: str = Field(description='its index in hexadecimal, and a sub-index: "6078", "2101:1"')
    type: TypeName | None = None
    """Data type; default: that of the standard, which has none for makers' objects."""
    name: str | None = Field(default=None, min_length=1, max_length=40)
    """Name in tables and pictures; default: the standard's, or the object itself."""
    scale: float | None = None
    """Factor of its number; default 1, for 6078h and 6079h the one that gives per cent and volts."""
    unit: str | None = Field(default=None, max_length=20)
    """Unit of the product."""

    @field_validator("object")
    @classmethod
    def _is_object(cls, text: str) -> str:
        match = _OBJECT.fullmatch(text)
        if match is None or int(match[2] or 0) > 0xFF:
            raise ValueError('an object ("6078"), or with its sub-index ("2101:1")')
        return text.upper()

    @property
    def key(self) -> tuple[int, int]:
        """Index and sub-index."""
        index, _, sub = self.object.partition(":")
        return int(index, 16), int(sub or 0)

    @property
    def code(self) -> str | None:
        """``struct`` character; None: unknown."""
        index, sub = self.key
        kind = type_by_name(self.type) if self.type else standard_type(index, sub or None)
        return None if kind is None else STRUCT_CODES.get(DataType(kind))

    @property
    def entry(self) -> PdoEntry:
        """The PDO entry."""
        assert self.code is not None
        return PdoEntry(*self.key, self.code)

    @property
    def title(self) -> str:
        """The name shown."""
        index, sub = self.key
        return self.name or self._standard.name or object_name(index, sub)

    @property
    def factor(self) -> float:
        """Factor of its number."""
        return self.scale if self.scale is not None else self._standard.factor

    @property
    def told_unit(self) -> str:
        """Unit of the product; empty: unknown."""
        if self.unit is not None:
            return self.unit
        return self._standard.unit if self.scale is None else ""

    @property
    def _standard(self) -> _Standard:
        return _STANDARDS.get(self.key[0], _Standard())


def _long(value: Any) -> Any:
    return {"object": value} if isinstance(value, str) else value


Observe = Annotated[
    tuple[Annotated[ObservedObject, BeforeValidator(_long)], ...], Field(strict=False, max_length=ENTRIES_MAX)
]


def observed_faults(key: str, observed: tuple[ObservedObject, ...]) -> Iterator[tuple[str, object, str, str]]:
    """Yield objects that cannot be sent by PDO, or are sent anyway; ``key``: that of the list."""
    objects, titles = Counter(each.key for each in observed), Counter(each.title for each in observed)
    for place, each in enumerate(observed):
        here = f"{key}[{place}]"
        if each.key[0] in _OF_THE_LOOP:
            yield f"{here}.object", each.object, "an object that the loop does not read anyway", ""
        elif each.code is None:
            remedy = 'type = "int16", "uint32", ... as the maker\'s manual has it'
            yield f"{here}.type", each.type or "nothing", "the data type of a maker's object", remedy
        if objects[each.key] > 1:
            yield f"{here}.object", each.object, "each object once", ""
        elif titles[each.title] > 1:
            yield f"{here}.name", each.title, "a name of its own", ""


def _lack(text: str) -> str:
    if re.match(PATTERN, text) is None:
        raise ValueError('an object ("6074"), a sub-index ("1400:5") or "tpdo events"')
    return text


Lack = Annotated[str, AfterValidator(_lack)]


def _of_like(data: Mapping[str, Any], name: str, default: int) -> int:
    like = data["like"]
    return default if like is None else like.rates.get(name, default)


class Simulation(Section):
    """``simulation``: the drive that the bench makes itself on the bus ``simulated``."""

    like: DriveModel | None = None
    """Its supply, protection, inverter, current sensors, encoder and rate, as the name of a preset, the path
    of a file, or its tables; default: a DC link without end, no protection, no errors."""
    encoder_counts_per_revolution: int = Field(
        default_factory=lambda data: _of_like(data, "encoder_counts_per_revolution", 65536), ge=16, le=2**30
    )
    """Default: that of ``like``, or 65536."""
    inner_rate_hz: int = Field(
        default_factory=lambda data: _of_like(data, "inner_rate_hz", 16000), ge=4000, le=64000
    )
    """Rate of the current loops; default: that of ``like``, or 16000."""
    clock_drift_ppm: float = Field(default=0.0, ge=-1000, le=1000)
    """Drift of the drive's clock: how much faster than the host's it runs."""
    stamp_unit_us: float = Field(default=1.0, ge=0.01, le=1000)
    """One count of the drive's stamp 1013h."""
    stamp_resolution_us: float = Field(default=1.0, ge=0.01, le=1000)
    """Step of the stamp."""
    stamp_bits: int = Field(default=32, ge=STAMP_BITS[0], le=STAMP_BITS[-1])
    """The stamp counts modulo 2^stamp_bits."""
    stamp_latched: StampLatch = "sampling"
    """At the instant of sampling, at the arrival of the SYNC, or at the next tick of the current loops."""
    stamp_late_us: float = Field(default=0.0, ge=0, le=STAMP_LATE_MAX_NS / NS_PER_US)
    """Delay of the latch after that instant."""
    stamp_runs: bool = True
    """False: 1013h holds a value written by a master."""
    sync_jitter_us: float = Field(default=0.0, ge=0, le=1000)
    """The drive acts on a SYNC, and samples, up to this much after its end; drawn evenly for each."""
    sync_phase_us: float | None = Field(default=None, ge=0, le=20_000)
    """Delay of its actions behind the SYNC as filtered by its phase-locked loop; absent: it has no such
    loop."""
    resistance_factor: float = Field(default=1.0, gt=0, le=10)
    """The simulated motor's resistance relative to the motor file's, for which its drive was set."""
    inductance_factor: float = Field(default=1.0, gt=0, le=10)
    """The same for both inductances."""
    current_bandwidth_hz: float | None = Field(default=None, gt=0)
    """Bandwidth of the PI current loops; default: a twentieth of the inner rate."""
    gain_objects: bool = False
    """The drive has the gains of its own loops as objects: 2121h, or those of its data sheet's maker."""
    lacks: Annotated[tuple[Lack, ...], Field(strict=False)] = ()
    """Parts that the drive lacks: objects ("6074"), sub-indices ("1400:5"), "tpdo events"."""
    eds: str | None = None
    """Data sheet (EDS, DCF, XDD, XDC) of the simulated drive, relative to the bench file; absent:
    servobench's own drive."""
    motor: MotorFile | None = None
    """The motor on its shaft, as a motor file or its tables; default: ``drive.NAME.motor``."""
    believes: MotorFile | None = None
    """The motor that the drive reckons with, as a motor file or its tables; default: the one on its shaft, at
    its sheet's temperature and with constant inductances."""
    rehearse: int | None = Field(default=None, ge=0)
    """Seed of `hil rehearse`, whose drive with its motor and encoder is simulated instead."""

    @property
    def current_loop_hz(self) -> float:
        """Bandwidth of the PI current loops, Hz."""
        return current_bandwidth_hz(self.current_bandwidth_hz, self.inner_rate_hz)


SET_SPEED_SHARE = 0.8
"""Share, for set-points, of the speed at which the bench stops a drive: a speed loop of phase margin 60
degrees overshoots a step by a tenth, and a load step adds to that."""


class Limits(Section):
    """``limits``: the host's limits for the drive, whatever the controller commands."""

    speed_max_rpm: Speed = Field(description="the speed at which the bench stops the drive, r/min")
    torque_max_nm: Torque = Field(description="the largest torque set-point, N m")
    torque_slew_max_nm_s: SlewRate | None = None
    """Slew rate of the set-points in ``mode = "cst"``."""
    set_speed_max_rpm: Speed | None = None
    """The largest speed set-point in csv and vl, and the largest rate of position set-points in csp and ip;
    default: 80 % of ``speed_max_rpm``, as the drive's own loop overshoots."""
    set_acceleration_max_rpm_s: SlewRate | None = None
    """Acceleration of the speed set-points in csv and vl, where the drive's own ramps (6048h, 6049h) are set
    to it, and along the position set-points in csp and ip."""
    dropouts_consecutive_max: DropoutsInARow = 100
    """With more consecutive cycles without a reading the bench stops the drive."""
    quick_stop_deceleration_rpm_s: SlewRate | None = None
    """Deceleration of the drive on a quick stop, or when it loses the host (0x6085); default: its own."""

    @property
    def speed_max_rad_s(self) -> float:
        """``speed_max_rpm`` in rad/s."""
        return self.speed_max_rpm * RAD_S_PER_RPM

    @property
    def set_speed_rpm(self) -> float:
        """``set_speed_max_rpm``, or its default."""
        limit = self.set_speed_max_rpm
        return SET_SPEED_SHARE * self.speed_max_rpm if limit is None else limit

    @property
    def set_acceleration_max_rad_s2(self) -> float | None:
        """``set_acceleration_max_rpm_s`` in rad/s^2."""
        limit = self.set_acceleration_max_rpm_s
        return None if limit is None else limit * RAD_S_PER_RPM

    @property
    def quick_stop_deceleration_rad_s2(self) -> float | None:
        """``quick_stop_deceleration_rpm_s`` in rad/s^2."""
        deceleration = self.quick_stop_deceleration_rpm_s
        return None if deceleration is None else deceleration * RAD_S_PER_RPM


DriveMode = Literal["cst", "csv", "csp", "ip", "vl"]


class DriveConfig(Section):
    """One axis: its drive, motor and controller."""

    node: int = Field(ge=1, le=127, description="the drive's CANopen node id, 1..127")
    segment: str | None = None
    """Name of the ``[[bus.segment]]`` of the drive; None: the first one."""
    mode: DriveMode = "cst"
    """Mode in which the drive is run: cyclic synchronous torque, velocity or position, interpolated position,
    or velocity mode. Its commands are torques, speeds or positions accordingly."""
    motor: MotorFile = Field(description="the path of a motor file, or its tables inline")
    eds: str | None = None
    """Data sheet (EDS, DCF, XDD, XDC) of the drive, relative to the bench file, used to plan its PDOs."""
    commissioned: DriveFile | None = None
    """Result of ``hil commission`` for the drive: the path of its drive.toml, or the tables inline."""
    unwatched: bool = False
    """Accept a drive without 1016h or 1017h: one side then does not notice that the other is gone."""
    heartbeat_ms: int = Field(default=50, ge=1, le=65_535)
    """Period of the drive's own heartbeat (0x1017)."""
    heartbeat_timeout_ms: HeartbeatTimeout = 150
    """A drive that is silent for this long counts as lost."""
    observe: Observe = ()
    """Objects that the drive sends by PDO for the recording alone; see docs/recording.md."""
    observe_every_cycles: int = Field(default=1, ge=1, le=SYNCHRONOUS_MAX)
    """They come with every n-th SYNC."""
    stamp_resolution_us: float | None = Field(default=None, ge=0.01, le=1000)
    """Step of the drive's stamp (1013h), as found by ``hil measure``; default: by its make, else 1 us."""
    count_with_speed: bool | None = None
    """Position 6064h in the frame of the speed 606Ch, so that both are of one SYNC; the stamp 1013h then has
    no room. Default: if the controller needs it."""
    simulation: Simulation = Simulation()
    current_control: CurrentControl = CurrentControl()
    limits: Limits = Field(description="a table with speed_max_rpm and torque_max_nm")
    compensator: CompensatorSection = ArrivalCompensator(kind="arrival")
    controller: ControllerSection = Field(description="a table with its kind, e.g. 'pid', or a path")

    @property
    def stamp_resolution(self) -> Duration | None:
        """``stamp_resolution_us`` in ns."""
        us = self.stamp_resolution_us
        return None if us is None else Duration(round(us * NS_PER_US))

    @property
    def follows(self) -> tuple[Quantity, ...]:
        """Quantities of which its reference can be, the usual one first."""
        return self.controller.follows(QUANTITY_BY_MODE[self.mode])

    @property
    def observed(self) -> Observed:
        """``observe`` in the form for the drive."""
        return Observed(tuple(each.entry for each in self.observe if each.code), self.observe_every_cycles)
