"""Set-up of a drive before it is enabled: heartbeats, reactions, limits, mode and PDOs.

Optional objects degrade one by one: each that is missing, refused or held otherwise becomes a note. A missing
necessity raises.

Objects that a drive sends with SYNCs for the recording alone: the loop does not use them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from servobench.drivers.canopen.error_control import WatchTimes
from servobench.drivers.canopen.objects import RemoteObjects, SettingRefused, write_greatest
from servobench.drivers.canopen.objects301 import Cia301, object_name
from servobench.drivers.canopen.pdo import BITS_MAX, PdoDirection, PdoEntry, PdoMap, PdoPlan, write_plan
from servobench.drivers.canopen.pdo_capability import PdoCapability
from servobench.drivers.canopen.write_list import Product
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import (
    AbortConnectionOption,
    DisableOperationOption,
    FaultReactionOption,
    Mode,
    QuickStopOption,
    ShutdownOption,
    no_drive,
)
from servobench.drivers.cia402.quirky_units import apply_quirks
from servobench.drivers.cia402.scaling import FACTOR_OBJECTS, ScaleOverride, Scaling, scaling_from
from servobench.drivers.errors import PeerFault, TransferAborted
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration
from servobench.drivers.vendors.families import quirks_for, stamp_for
from servobench.drivers.vendors.stamps import STANDARD_STAMP, StampProfile

NUMBERS = range(1, 5)
"""TPDOs with a predefined identifier."""
_REMEDY = "take it out of the bench file's observe"


class Observed(NamedTuple):
    """The objects to be sent."""

    entries: tuple[PdoEntry, ...] = ()
    every_cycles: int = 1
    """With every so many SYNCs."""


NOTHING = Observed()


class NotObservable(PeerFault):
    """A drive cannot send an object by PDO; ``evidence`` holds its own words."""


def with_observed(plan: PdoPlan, node_id: int, observed: Observed) -> PdoPlan | None:
    """Fill the TPDOs that ``plan`` leaves free, one after the other; None: they do not hold everything."""
    used = {pdo.number for pdo in plan.tpdos}
    free = [number for number in NUMBERS if number not in used]
    contents = _packed(observed.entries)
    if len(contents) > len(free):
        return None
    sent = PdoDirection.TRANSMIT
    maps = [
        PdoMap(sent, number, sent.default_cob_id(number, node_id), entries, observed.every_cycles)
        for number, entries in zip(free, contents, strict=False)
    ]
    return replace(plan, observed=tuple(maps))


def _packed(entries: Iterable[PdoEntry]) -> list[tuple[PdoEntry, ...]]:
    pdos: list[tuple[PdoEntry, ...]] = []
    for entry in entries:
        last = pdos[-1] if pdos else ()
        if not pdos or sum(each.bits for each in last) + entry.bits > BITS_MAX:
            pdos.append((entry,))
        else:
            pdos[-1] = (*last, entry)
    return pdos


def map_observed(objects: RemoteObjects, plan: PdoPlan, observed: Observed) -> tuple[PdoPlan, list[str]]:
    """Write them into the drive, which holds ``plan`` and is pre-operational; return notes on what was done.

    Raises NotObservable.
    """
    if not observed.entries:
        return plan, []
    for entry in observed.entries:
        _check(objects, entry)
    whole = with_observed(plan, objects.node_id, observed)
    if whole is None:
        serving = ", ".join(pdo.name for pdo in plan.tpdos)
        names = _names(observed.entries)
        raise NotObservable(
            f"node {objects.node_id} has no TPDO left for {names}", f"{serving} serve the loop", _REMEDY
        )
    try:
        return whole, write_plan(objects, whole)
    except (TransferAborted, SettingRefused) as error:
        raise NotObservable(
            f"node {objects.node_id} does not map {_names(observed.entries)}", error.evidence, _REMEDY
        ) from error


def _check(objects: RemoteObjects, entry: PdoEntry) -> None:
    name = object_name(entry.index, entry.sub)
    try:
        data = objects.network.upload(objects.node_id, entry.index, entry.sub)
    except TransferAborted as error:
        raise NotObservable(f"node {objects.node_id}: {name}", error.evidence, _REMEDY) from error
    if len(data) * 8 != entry.bits:
        raise NotObservable(
            f"node {objects.node_id}: {name} has {len(data)} bytes",
            f"the bench file's type has {entry.bits // 8}",
            "give its type as the maker's manual has it",
        )


def _names(entries: Sequence[PdoEntry]) -> str:
    return ", ".join(object_name(entry.index, entry.sub) for entry in entries)


NO_CHANGE_OF_NMT_STATE = 1
"""1029h:01. In PRE-OPERATIONAL, the default, or STOPPED a drive would still come to rest by 6007h, but its
PDOs would be silent: the host could not see the statusword fall, nor the speed go down."""


_SUB_MODE = Object.INTERPOLATION_SUB_MODE_SELECT
_LINEAR = 0
"""The one sub-mode of 60C0h that CiA 402-2 defines; a maker's own may be by polynomials, or from a buffer."""


class Identity(NamedTuple):
    """Identity of a node: 0x1018, 0x1008 and 0x1000; 0 or empty where the device reports nothing."""

    device_name: str
    vendor: int
    product: int
    revision: int
    serial: int
    device_type: int

    @property
    def stamp(self) -> StampProfile:
        """How drives of that make stamp their samples."""
        return stamp_for(self.vendor, self.product, self.device_name)

    def __str__(self) -> str:
        name = self.device_name or "unnamed device"
        return f"{name} (vendor {self.vendor:08X}h, product {self.product:08X}h, serial {self.serial})"


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """The bench's settings for a drive; None leaves the drive's own value."""

    sync_period_ns: Duration
    plan: PdoPlan | None = None
    """None: one for :attr:`capability`, else :func:`servobench.drivers.cia402.pdo_planner.mode_plan`."""
    capability: PdoCapability | None = None
    """PDO capability from the drive's dictionary; None without a dictionary."""
    mode: Mode = Mode.CYCLIC_SYNCHRONOUS_TORQUE
    """The mode to begin with."""
    synchronous_command: bool = False
    """The drive applies the set-point at the next SYNC, not on arrival. Without effect beside ``plan``."""
    position_every_cycles: int = 1
    """See :class:`servobench.drivers.cia402.pdo_plans.PlanWish`. Without effect beside ``plan``."""
    coherent: bool = False
    """See :func:`servobench.drivers.cia402.pdo_plans.layout`. Without effect beside ``plan``."""
    counted: bool = False
    """Position and speed are to travel in one TPDO. Without effect beside ``plan``."""
    command_timeout_ms: int | None = None
    """A drive that hears no command for this long is to stop; None: not supervised. Takes effect with
    ``supervise_commands``."""
    demand_changes: bool = False
    """Have every change of the torque demand sent with the drive's stamp: when a command begins to act."""
    stamp: StampProfile = STANDARD_STAMP
    """How the drive stamps its samples; the drive that is configured knows it by its make."""
    observed: Observed = NOTHING
    """Objects that the drive sends for the recording alone."""
    drive_heartbeat_ms: int = 50
    drive_heartbeat_timeout_ms: int = 150
    """A drive that is silent for longer counts as lost."""
    host_heartbeat_ms: int = 50
    host_heartbeat_timeout_ms: int = 150
    """A drive that does not hear the host for this long stops by itself."""
    bears_lapses: bool = False
    """Go on with a drive that does not follow its commands."""
    unwatched: bool = False
    """Accept a drive that lacks 1016h or 1017h and cannot be guarded: one side then does not notice that the
    other is gone."""
    torque_max_nm: float | None = None
    speed_max_rad_s: float | None = None
    set_acceleration_rad_s2: float | None = None
    """Steepest change of the speeds commanded (in csp: slope of the set-points); the drive's own ramps of the
    velocity mode (6048h, 6049h) and its bounds in csv and csp (60C5h, 60C6h) must let it pass."""
    quick_stop_deceleration_rad_s2: float | None = None
    quick_stop_option: QuickStopOption = QuickStopOption.QUICK_STOP_RAMP
    """Stop on a quick stop and in the reaction to a fault: 605Ah and 605Eh share their values."""
    scale: ScaleOverride = field(default_factory=ScaleOverride)

    def __post_init__(self) -> None:
        if self.sync_period_ns <= 0:
            raise ValueError("sync_period_ns must be positive")
        if not 0 < self.host_heartbeat_ms < self.host_heartbeat_timeout_ms <= 0xFFFF:
            raise ValueError(
                "host_heartbeat_ms must be below host_heartbeat_timeout_ms, and that below 65536"
            )
        if not 0 < self.drive_heartbeat_ms < self.drive_heartbeat_timeout_ms <= 0xFFFF:
            raise ValueError(
                "drive_heartbeat_ms must be below drive_heartbeat_timeout_ms, and that below 65536"
            )
        if self.command_timeout_ms is not None and not 0 < self.command_timeout_ms <= 0xFFFF:
            raise ValueError("command_timeout_ms must be in 1..65535")

    @property
    def watch_times(self) -> WatchTimes:
        """Heartbeat periods and time-outs on both sides."""
        return WatchTimes(
            self.drive_heartbeat_ms,
            self.drive_heartbeat_timeout_ms,
            self.host_heartbeat_ms,
            self.host_heartbeat_timeout_ms,
        )


class Reaction(NamedTuple):
    """An option code, INTEGER16, and its meaning."""

    object: Object
    value: int
    text: str


REACTIONS = (
    Reaction(
        Object.ABORT_CONNECTION_OPTION, AbortConnectionOption.QUICK_STOP, "quick stop when the host is lost"
    ),
    Reaction(
        Object.QUICK_STOP_OPTION, QuickStopOption.QUICK_STOP_RAMP, "quick stop by its ramp, then disabled"
    ),
    Reaction(Object.SHUTDOWN_OPTION, ShutdownOption.SLOW_DOWN_RAMP, "shutdown by ramp"),
    Reaction(Object.DISABLE_OPERATION_OPTION, DisableOperationOption.SLOW_DOWN_RAMP, "disable by ramp"),
    Reaction(
        Object.FAULT_REACTION_OPTION, FaultReactionOption.QUICK_STOP_RAMP, "fault reaction by quick stop ramp"
    ),
)
"""Reactions that bring a drive to rest by itself when it is left alone."""


def read_identity(objects: RemoteObjects) -> Identity:
    """Read device name, identity object and device type; raises PeerFault if it is no CiA 402 device.

    From then on the network knows which product the node is.
    """
    device_type = objects.read(Cia301.DEVICE_TYPE)
    why = no_drive(device_type, lambda: objects.read_if_there(Object.STATUSWORD, 0, "H") is not None)
    if why:
        raise PeerFault(
            f"node {objects.node_id} on {objects.network.link.name} is no servo drive",
            why,
            f"check the node id; hil scan --bus {objects.network.link.name} shows who is there",
        )
    vendor, product, revision, serial = (
        objects.read_if_there(Cia301.IDENTITY, sub) or 0 for sub in (1, 2, 3, 4)
    )
    name = objects.read_text(Cia301.DEVICE_NAME)
    objects.network.writes.products[objects.node_id] = Product(vendor, product, name)
    return Identity(name, vendor, product, revision, serial, device_type)


def read_scaling(objects: RemoteObjects, override: ScaleOverride) -> Scaling:
    """Work out the drive's units from its factor objects, and from what is known about its make."""
    values = {(index, sub): objects.read_if_there(index, sub) for index, sub in FACTOR_OBJECTS}
    vendor, product = (objects.read_if_there(Cia301.IDENTITY, sub) or 0 for sub in (1, 2))
    quirks = quirks_for(vendor, product, objects.read_text(Cia301.DEVICE_NAME))
    known = apply_quirks(quirks, values, override, objects.read_if_there)
    scaling = scaling_from(known.values, known.override)
    notes = (*known.notes, *_polarity_notes(objects.read_if_there(Object.POLARITY, 0, "B") or 0))
    return replace(scaling, sources={**scaling.sources, **known.sources}, notes=notes)


def _polarity_notes(polarity: int) -> list[str]:
    """Note what 0x607E does: it reverses positions (bit 7) and velocities (bit 6), not torque."""
    turned = [name for bit, name in ((0x80, "positions"), (0x40, "velocities")) if polarity & bit]
    if not turned:
        return []
    return [f"607Eh turns the sign of {' and '.join(turned)}, not of torque: see that the loop pushes back"]


def write_reactions(objects: RemoteObjects, stop: QuickStopOption) -> list[str]:
    """Write the option codes; return notes on those that the drive lacks or holds otherwise."""
    notes = []
    for index, value, text in REACTIONS:
        if index in (Object.QUICK_STOP_OPTION, Object.FAULT_REACTION_OPTION):
            value = int(stop)
        notes += write_optional(objects, index, "h", value, text)
    if objects.read_if_there(Cia301.ERROR_BEHAVIOUR, 1, "B") is not None:
        text = "NMT state kept when the host is lost"
        notes += write_optional(objects, Cia301.ERROR_BEHAVIOUR, "B", NO_CHANGE_OF_NMT_STATE, text, sub=1)
    return notes


def write_limits(objects: RemoteObjects, settings: DriveSettings, scaling: Scaling) -> list[str]:
    """Write limits and periods; return notes on those that the drive lacks or holds otherwise."""
    notes: list[str] = []
    if settings.torque_max_nm is not None:
        raw = min(round(settings.torque_max_nm / scaling.torque_nm), 0xFFFF)
        notes += write_greatest(objects, Object.MAX_TORQUE, "H", raw, "torque limit").notes
    if settings.speed_max_rad_s is not None:
        raw = round(settings.speed_max_rad_s / RAD_S_PER_RPM)
        notes += write_greatest(objects, Object.MAX_MOTOR_SPEED, "I", raw, "speed limit, rev/min").notes
    if settings.quick_stop_deceleration_rad_s2 is not None:
        raw = round(settings.quick_stop_deceleration_rad_s2 / scaling.acceleration_rad_s2)
        raw, text = min(max(1, raw), 0xFFFF_FFFF), "quick stop deceleration"
        notes += write_greatest(objects, Object.QUICK_STOP_DECELERATION, "I", raw, text).notes
    period_us = settings.sync_period_ns // NS_PER_US
    notes += write_optional(objects, Cia301.CYCLE_PERIOD, "I", period_us, "SYNC period, us")
    notes += _write_interpolation_time(objects, settings.sync_period_ns)
    if settings.mode is Mode.INTERPOLATED_POSITION and objects.read_if_there(_SUB_MODE, 0, "h"):
        notes += write_optional(objects, _SUB_MODE, "h", _LINEAR, "linear interpolation, without a buffer")
    return notes


def _write_interpolation_time(objects: RemoteObjects, period_ns: Duration) -> list[str]:
    """Write 0x60C2: sub 1 times ten to the power of sub 2 seconds, an UNSIGNED8 and an INTEGER8."""
    for exponent, unit_ns in (
        (-3, NS_PER_MS),
        (-4, NS_PER_MS // 10),
        (-5, NS_PER_MS // 100),
        (-6, NS_PER_US),
    ):
        if period_ns % unit_ns == 0 and period_ns // unit_ns <= 0xFF:
            text = "interpolation time"
            notes = write_optional(objects, Object.INTERPOLATION_TIME_PERIOD, "b", exponent, text, sub=2)
            value = period_ns // unit_ns
            return notes or write_optional(objects, Object.INTERPOLATION_TIME_PERIOD, "B", value, text, sub=1)
    return [f"60C2h: a period of {period_ns} ns cannot be told to the drive"]


def write_optional(
    objects: RemoteObjects, index: int, code: str, value: int, text: str, sub: int = 0
) -> list[str]:
    """Write and read back; a note if the object is missing, refuses, or holds another value afterwards."""
    name = object_name(index, sub)
    if objects.read_if_there(index, sub, code) is None:
        return [f"{name} is missing: {text} left to the drive"]
    try:
        objects.write_verified(index, sub, code, value)
    except TransferAborted as error:
        return [f"{name} refused {value} ({text}): {error.evidence}"]
    except SettingRefused as error:
        return [f"{text}: {error.summary}, {value} was asked for"]
    return []
