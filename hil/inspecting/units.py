"""Parameters in SI units: by a drive's factor objects (CiA 402-2), by the profile's fixed units, and by the
data sheet's own words for a maker's objects."""

from contextlib import suppress
from typing import Final, NamedTuple

from canopen.objectdictionary import ObjectDictionary

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.objects301 import MANUFACTURER, SIGNED_BITS, Cia301
from servobench.drivers.cia402.drive_setup import read_scaling
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.scaling import FACTOR_OBJECTS, ScaleOverride, Scaling, scaling_from
from servobench.drivers.errors import PeerFault
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.sheets.dictionary import held_number, variables_in

Place = tuple[int, int]
"""Index and sub-index."""
_POSITIONS: Final = (
    Object.POSITION_RANGE_LIMIT, Object.SOFTWARE_POSITION_LIMIT, Object.FOLLOWING_ERROR_WINDOW,
    Object.POSITION_WINDOW, Object.HOME_OFFSET,
)  # fmt: skip
_VELOCITIES: Final = (
    Object.MAX_PROFILE_VELOCITY, Object.PROFILE_VELOCITY, Object.HOMING_SPEEDS, 0x606D, 0x606F,
)  # fmt: skip
_ACCELERATIONS: Final = (
    Object.PROFILE_ACCELERATION, Object.PROFILE_DECELERATION, Object.QUICK_STOP_DECELERATION,
    Object.HOMING_ACCELERATION, Object.MAX_ACCELERATION, Object.MAX_DECELERATION,
)  # fmt: skip
_TORQUES: Final = (Object.MAX_TORQUE, 0x60E0, 0x60E1)
_MS: Final = (Cia301.GUARD_TIME, Cia301.PRODUCER_HEARTBEAT_TIME, 0x6066, 0x6068, 0x606E, 0x6070)


class SiUnit(NamedTuple):
    """SI value = raw value times ``factor``."""

    factor: float
    text: str


def read_units(network: CanopenNetwork, node: int, dictionary: ObjectDictionary) -> dict[Place, SiUnit]:
    """Return the units of a drive's parameters; those that it does not tell are left out."""
    scaling = None
    with suppress(PeerFault):
        scaling = read_scaling(RemoteObjects(network, node), ScaleOverride())
    return _units(dictionary, scaling)


def units_of(dictionary: ObjectDictionary) -> dict[Place, SiUnit]:
    """Return the units of a file's parameters, by its own values of the factor objects."""
    scaling = None
    with suppress(PeerFault):
        scaling = scaling_from({place: held_number(dictionary, *place) for place in FACTOR_OBJECTS})
    return _units(dictionary, scaling)


def with_unit(value: bytes, data_type: int | None, unit: SiUnit | None) -> str:
    """Return a raw number in its unit, ``0.8 N m``; empty without one."""
    if unit is None or not value:
        return ""
    number = int.from_bytes(value, "little", signed=data_type in SIGNED_BITS)
    return f"{number * unit.factor:.6g} {unit.text}"


def _units(dictionary: ObjectDictionary, scaling: Scaling | None) -> dict[Place, SiUnit]:
    units = dict[int, SiUnit]()
    units |= _each((Object.MAX_MOTOR_SPEED,), RAD_S_PER_RPM, "rad/s") | _each(_MS, 1e-3, "s")
    if scaling is not None:
        units |= _each(_POSITIONS, scaling.position_rad, "rad")
        units |= _each(_VELOCITIES, scaling.velocity_rad_s, "rad/s")
        units |= _each(_ACCELERATIONS, scaling.acceleration_rad_s2, "rad/s^2")
        units |= _each(_TORQUES, scaling.torque_nm, "N m")
        units |= _each((Object.TORQUE_SLOPE,), scaling.torque_nm, "N m/s")
        if scaling.rated_current_a is not None:
            units |= _each((Object.MAX_CURRENT,), scaling.rated_current_a / 1000.0, "A")
    found = {}
    for variable in variables_in(dictionary):
        is_count = variable.subindex == 0 and not isinstance(variable.parent, ObjectDictionary)
        unit = units.get(variable.index)
        if unit is None and variable.index in MANUFACTURER and variable.unit:
            unit = SiUnit(variable.factor or 1.0, variable.unit)
        if unit is not None and not is_count:
            found[variable.index, variable.subindex] = unit
    return found


def _each(indices: tuple[int, ...], factor: float, text: str) -> dict[int, SiUnit]:
    return dict.fromkeys(indices, SiUnit(factor, text))
