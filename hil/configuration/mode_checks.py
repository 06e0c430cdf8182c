"""Checks which controllers, references and limits go with a drive's mode."""

from collections.abc import Iterator
from typing import Final

from servobench.drivers.errors import MISSING
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.configuration.controller_kinds import controllers_giving
from servobench.hil.configuration.references import Reference, peak_level, peak_rate
from servobench.hil.loop.scenario import QUANTITY_BY_MODE, Quantity

Fault = tuple[str, object, str, str]
"""Key, value found, expected value, remedy."""

_OF_SPEEDS: Final = ("speed_error_peak_percent_max", "after_load_percent_max", "speed_error_rms_rad_s_max")
_OF_POSITIONS: Final = ("position_error_peak_rad_max", "position_error_rms_rad_max")


def mode_faults(config: BenchConfig) -> Iterator[Fault]:
    """Yield the values that do not go with a drive's mode."""
    for axis in config.axes:
        drive = config.drive[axis]
        given = QUANTITY_BY_MODE[drive.mode]
        if given not in drive.controller.gives:
            key, kinds = f"drive.{axis}.controller.kind", ", ".join(controllers_giving(given))
            expected = f'one of {kinds}: in mode = "{drive.mode}" the drive is given {given.value}s'
            yield key, drive.controller.kind, expected, ""
        yield from _limits_of_mode(f"drive.{axis}.limits", drive)
        if drive.mode != "cst" and config.loop.command_readback == "event":
            expected = f'"sync": {axis} is in {drive.mode}, and 6074h is the demand of a torque mode'
            yield "loop.command_readback", config.loop.command_readback, expected, ""
        if config.counted(axis) and config.loop.command_readback == "event":
            expected = f'"sync": events are told by the stamp 1013h, and 6064h takes its room on {axis}'
            remedy = f"or set drive.{axis}.count_with_speed = false"
            yield "loop.command_readback", config.loop.command_readback, expected, remedy
    yield from _verdict_of_modes(config)


def _limits_of_mode(key: str, drive: DriveConfig) -> Iterator[Fault]:
    limits = drive.limits
    if drive.mode != "cst" and limits.torque_slew_max_nm_s is not None:
        expected = f'absent with mode = "{drive.mode}", in which no torque is commanded'
        yield f"{key}.torque_slew_max_nm_s", limits.torque_slew_max_nm_s, expected, ""
    for name in ("set_speed_max_rpm", "set_acceleration_max_rpm_s"):
        value = getattr(limits, name)
        if drive.mode == "cst" and value is not None:
            yield f"{key}.{name}", value, 'absent with mode = "cst", in which torques are commanded', ""
    if limits.set_speed_max_rpm is not None and limits.set_speed_max_rpm >= limits.speed_max_rpm:
        expected = f"less than {key}.speed_max_rpm = {limits.speed_max_rpm:g}"
        yield f"{key}.set_speed_max_rpm", limits.set_speed_max_rpm, expected, "a speed loop overshoots"


def _verdict_of_modes(config: BenchConfig) -> Iterator[Fault]:
    quantities = {config.quantity(axis) for axis in config.axes}
    given = {QUANTITY_BY_MODE[drive.mode] for drive in config.drive.values()}
    applies = (
        (_OF_SPEEDS, Quantity.SPEED in quantities, "an axis with a speed reference"),
        (_OF_POSITIONS, Quantity.POSITION in quantities, "an axis with a position reference"),
        (("following_error_peak_rad_max",), Quantity.POSITION in given, 'an axis with mode = "csp" or "ip"'),
        (("torque_rms_nm_max",), Quantity.TORQUE in given, 'an axis with mode = "cst"'),
    )
    for keys, there, expected in applies:
        for key in keys:
            value = getattr(config.verdict, key)
            if value is not None and not there:
                yield f"verdict.{key}", value, f"absent, or {expected}: there is none", ""


def reference_faults(axis: str, drive: DriveConfig, config: BenchConfig) -> Iterator[Fault]:
    """Yield entries of no quantity, of one that the axis cannot take, or beyond its limits."""
    entries, table = config.reference.get(axis, ()), f"reference.{axis}"
    for index, entry in enumerate(entries):
        if not entry.told:
            described = type(entry).model_fields[entry.keys[0]].description
            expected = f"{described}; or one of {', '.join(entry.keys[1:])}"
            yield f"{table}[{index}].{entry.keys[0]}", MISSING, expected, ""
            return
        if len(entry.told) > 1:
            key = entry.told[1][1]
            expected = f"absent beside {entry.told[0][1]}: an entry is of one quantity"
            yield f"{table}[{index}].{key}", getattr(entry, key), expected, ""
            return
        if entry.quantity not in drive.follows:
            taken = " or ".join(each.value for each in drive.follows)
            plural = " or ".join(f"{each.value}s" for each in drive.follows)
            why = f'a {drive.controller.kind} controller in mode = "{drive.mode}" takes {plural}'
            yield f"{table}[{index}].{entry.told[0][1]}", entry.level, f"a {taken}: {why}", ""
            return
        first = entries[0].quantity
        if entry.quantity is not first:
            why = f"all entries of an axis are of one quantity, here a {first.value}"
            yield f"{table}[{index}].{entry.told[0][1]}", entry.level, f"a {first.value}: {why}", ""
            return
    if entries:
        yield from _beyond(table, entries, axis, drive)


def _beyond(table: str, entries: tuple[Reference, ...], axis: str, drive: DriveConfig) -> Iterator[Fault]:
    limits, quantity = drive.limits, entries[0].quantity
    key, remedy = f"drive.{axis}.limits", ""
    if quantity is Quantity.TORQUE:
        peak, name, limit = peak_level(entries), "torque_max_nm", limits.torque_max_nm
    elif quantity is Quantity.SPEED and drive.mode == "cst":
        peak, name, limit = peak_level(entries), "speed_max_rpm", limits.speed_max_rpm
        remedy = "the bench would stop the drive there"
        if peak == limit:
            yield table, peak, f"less than {key}.{name} = {limit:g}", remedy
    elif quantity is Quantity.SPEED:
        peak, name, limit = peak_level(entries), "set_speed_max_rpm", limits.set_speed_rpm
    elif drive.mode == "cst":
        peak, name, limit = peak_rate(entries) / RAD_S_PER_RPM, "speed_max_rpm", limits.speed_max_rpm
        remedy = "the bench would stop the drive there"
    else:
        peak, name, limit = peak_rate(entries) / RAD_S_PER_RPM, "set_speed_max_rpm", limits.set_speed_rpm
    if peak > limit:
        less = "less than" if remedy else "at most"
        what = "of its rate, r/min, " if quantity is Quantity.POSITION else ""
        yield table, peak, f"{what}{less} {key}.{name} = {limit:g}", remedy
