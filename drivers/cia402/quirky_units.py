"""A drive's units where the maker's objects differ from CiA 402."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.scaling import ScaleOverride, increment_of
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.vendors.families import Quirk

Values = dict[tuple[int, int], int | None]


@dataclass(frozen=True, slots=True)
class Applied:
    """Facts applied to a drive beyond its objects."""

    values: Values
    override: ScaleOverride
    sources: Mapping[str, str]
    """Source of each factor, by the names of ``Scaling.sources``."""
    notes: tuple[str, ...] = ()


def apply_quirks(
    quirks: Iterable[tuple[str, Quirk]],
    values: Mapping[tuple[int, int], int | None],
    override: ScaleOverride,
    read: Callable[[int, int], int | None],
) -> Applied:
    """Complete the drive's factor objects and the user's overrides by known quirks.

    ``read(index, sub)``: an object of the drive, None if it has none.
    """
    applied = Applied(dict(values), override, {})
    for name, quirk in quirks:
        applied = _apply(quirk, name, applied, read)
    return applied


def _apply(quirk: Quirk, name: str, so_far: Applied, read: Callable[[int, int], int | None]) -> Applied:
    values, override, sources = dict(so_far.values), so_far.override, dict(so_far.sources)
    notes = (*so_far.notes, quirk.note) if quirk.note else so_far.notes
    resolution = (Object.POSITION_ENCODER_RESOLUTION, 1)
    if quirk.increments_index is not None and not values.get(resolution):
        held = read(quirk.increments_index, quirk.increments_sub)
        if held:
            values[resolution], values[Object.POSITION_ENCODER_RESOLUTION, 2] = held, 1
            sources["position"] = f"{quirk.increments_index:04X}h:{quirk.increments_sub} ({name})"
    rated = values.get((Object.MOTOR_RATED_TORQUE, 0))
    if quirk.rated_torque_nm is not None and rated and override.rated_torque_nm is None:
        override = replace(override, rated_torque_nm=rated * quirk.rated_torque_nm)
        sources["torque"] = f"6076h in units of {quirk.rated_torque_nm:g} N m ({name})"
    increment, _ = increment_of(values, override.position_rad) or (None, "")
    if quirk.position_increments is not None and increment and override.position_rad is None:
        override = replace(override, position_rad=increment * quirk.position_increments)
        sources["position"] = f"{quirk.position_increments:g} increments ({name})"
    velocity = _velocity_rad_s(quirk, increment)
    told = values.get((Object.SI_UNIT_VELOCITY, 0))
    if velocity and not told and override.velocity_rad_s is None:
        override = replace(override, velocity_rad_s=velocity)
        sources["velocity"] = name
    return Applied(values, override, sources, notes)


def _velocity_rad_s(quirk: Quirk, increment_rad: float | None) -> float | None:
    if quirk.velocity_rpm is not None:
        return quirk.velocity_rpm * RAD_S_PER_RPM
    if quirk.velocity_increments_s is None or increment_rad is None:
        return None
    return quirk.velocity_increments_s * increment_rad
