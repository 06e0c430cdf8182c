"""The simulated drive behind another drive's data sheet: a rehearsal of that drive (CiA 306-1, CiA 402-2);
and the simulated motor in the objects in which a maker's drives keep theirs (drivers/vendors)."""

from typing import Final

import canopen.objectdictionary as od

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_plans import NEEDED_OBJECTS
from servobench.drivers.cia402.profile import Mode, supported_mode_bit, tells_modes
from servobench.drivers.cia402.scaling import ENCODER_COUNTS_MIN
from servobench.drivers.sheets.dictionary import held_number
from servobench.drivers.vendors.families import motor_objects_for, quirks_for
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary, Variable
from servobench.virtual_bus.device.vendor_dictionary import overlay
from servobench.virtual_bus.drive.power_stage import current_per_rms

_BOUNDLESS: Final = 0xFFFF_FFFF
_RAMPS: Final = (
    Object.PROFILE_ACCELERATION,
    Object.PROFILE_DECELERATION,
    Object.QUICK_STOP_DECELERATION,
    Object.TORQUE_SLOPE,
    Object.HOMING_ACCELERATION,
)
_RATINGS: Final = (Object.MOTOR_RATED_TORQUE, Object.MOTOR_RATED_CURRENT)


def lay_over(dictionary: ObjectDictionary, vendor: od.ObjectDictionary) -> None:
    """Make the simulated drive's ``dictionary`` what ``vendor``, loaded for BASE_NODE_ID, says.

    Beyond :func:`servobench.virtual_bus.device.vendor_dictionary.overlay`, where a drive of the sheet would
    differ from the simulated one in what it can do:

    6502h   the simulated drive's modes that the sheet tells, or does not deny; 6060h takes those whose object
            for a set-point, or for the method of homing, is there, and begins with the first, or with the
            sheet's where it cannot be written
    608Fh   the sheet's, read-only or not; less than four increments a turn are no encoder: they are shown,
            and the position unit stays the simulated encoder's
    ramps   a sheet's 0 in 6083h to 6085h, 6087h and 609Ah is shown; the drive then has the slowest ramp that
            there is, until it is written
    607Fh   bounds nothing where the sheet has none
    rating  6075h and 6076h are those of the simulated motor: the sheet's are of another one, or of none
    """
    modes = dictionary.variable(Object.SUPPORTED_DRIVE_MODES)
    ramps = [dictionary.variable(index) for index in _RAMPS]
    ratings = [dictionary.variable(index) for index in _RATINGS]
    rated = [variable.default for variable in ratings]
    resolution = [dictionary.variable(Object.POSITION_ENCODER_RESOLUTION, sub) for sub in (1, 2)]
    counts = [variable.default for variable in resolution]
    bound = dictionary.variable(Object.MAX_PROFILE_VELOCITY)
    overlay(dictionary, vendor)
    if Object.MAX_PROFILE_VELOCITY not in dictionary:
        bound.default = bound.value = _BOUNDLESS
    for variable, own in zip(ratings, rated, strict=True):
        variable.default = variable.value = own
    _take_modes(dictionary, modes, held_number(vendor, Object.SUPPORTED_DRIVE_MODES))
    _keep_mode(dictionary, held_number(vendor, Object.MODES_OF_OPERATION))
    file_resolution = [held_number(vendor, Object.POSITION_ENCODER_RESOLUTION, sub) for sub in (1, 2)]
    _take_resolution(resolution, counts, file_resolution)
    for ramp in ramps:
        if held_number(vendor, ramp.index) == 0:
            ramp.default = ramp.value = 1
            ramp.low = 0
            ramp.show_instead(0)


def only_modes(dictionary: ObjectDictionary, bits: int, *further: Variable) -> None:
    """Leave a drive the modes that these bits of 6502h name; it starts in one of them.
    ``further``: other words that tell the same bits."""
    for word in (*further, dictionary.get(Object.SUPPORTED_DRIVE_MODES)):
        if word is not None:
            word.default = word.value = bits
    mode = dictionary.variable(Object.MODES_OF_OPERATION)
    if mode.refusal(mode.default) is not None:
        first = next((each for each in sorted(NEEDED_OBJECTS) if mode.refusal(each) is None), Mode.NONE)
        _begin_in(dictionary, first)


def _keep_mode(dictionary: ObjectDictionary, held: int | None) -> None:
    mode = dictionary.variable(Object.MODES_OF_OPERATION)
    if held is not None and not mode.writable and mode.refusal(held) is None:
        _begin_in(dictionary, held)


def _begin_in(dictionary: ObjectDictionary, mode: int) -> None:
    for index in (Object.MODES_OF_OPERATION, Object.MODES_OF_OPERATION_DISPLAY):
        variable = dictionary.variable(index)
        variable.default = variable.value = int(mode)


def _take_modes(dictionary: ObjectDictionary, own: Variable, told: int | None) -> None:
    allowed = own.default & told if told and tells_modes(told) else own.default
    bits = sum(
        supported_mode_bit(mode)
        for mode, index in NEEDED_OBJECTS.items()
        if allowed & supported_mode_bit(mode) and index in dictionary
    )
    only_modes(dictionary, bits, own)
    shown = dictionary.get(Object.SUPPORTED_DRIVE_MODES)
    if shown is not None and allowed != bits and told and tells_modes(told):
        shown.show_instead(allowed)


def _take_resolution(own: list[Variable], counts: list[int], told: list[int | None]) -> None:
    increments, turns = told
    if not increments or not turns:
        return
    real = increments >= ENCODER_COUNTS_MIN * turns
    for variable, count, number in zip(own, counts, (increments, turns), strict=True):
        variable.default = variable.value = number if real else count
        if not real:
            variable.show_instead(number)


_PROFILE: Final = 0x6000


def tell_motor(dictionary: ObjectDictionary, motor: PmsmParameters) -> None:
    """Have the objects that ``dictionary`` has tell of ``motor``, by their maker's units and convention.

    What a data sheet has there is of another motor, or of none. Objects of the profile rule inside the drive
    by the standard's convention, and only show the maker's.
    """
    vendor, product = (_held(dictionary, Cia301.IDENTITY, sub) or 0 for sub in (1, 2))
    name = _held(dictionary, Cia301.DEVICE_NAME, 0)
    text = name.split(b"\0", 1)[0].decode("latin-1").strip() if isinstance(name, bytes) else ""
    figures = motor_figures(motor)
    rated = dictionary.get(Object.MOTOR_RATED_TORQUE)
    for _, quirk in quirks_for(int(vendor), int(product), text):
        if rated is not None and quirk.rated_torque_nm is not None:
            rated.show_instead(round(motor.rated_torque_nm / quirk.rated_torque_nm))
    for _, known in motor_objects_for(int(vendor), int(product), text):
        held = [dictionary.get(each.index, each.sub) for each in known.objects]
        if known.whole and None in held:
            continue
        for each, variable in zip(known.objects, held, strict=True):
            raw = each.raw(figures[each.quantity])
            if variable is None:
                continue
            if each.index >= _PROFILE:
                variable.show_instead(raw)
            else:
                variable.default = variable.value = raw


def motor_figures(motor: PmsmParameters) -> dict[str, float]:
    """By quantity of :data:`servobench.drivers.vendors.motor_objects.QUANTITIES`."""
    per_rms = current_per_rms(motor)
    return {
        "pole_pairs": float(motor.pole_pairs),
        "resistance_ohm": motor.resistance_ohm,
        "inductance_d_h": motor.inductance_d_h,
        "inductance_q_h": motor.inductance_q_h,
        "rated_current_a": motor.rated_current_a / per_rms,
        "torque_constant_nm_a": motor.torque_constant_nm_a * per_rms,
    }


def _held(dictionary: ObjectDictionary, index: int, sub: int) -> int | bytes | None:
    variable = dictionary.get(index, sub)
    return None if variable is None else variable.default
