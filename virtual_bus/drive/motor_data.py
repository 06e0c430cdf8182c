"""The simulated motor in the objects in which a maker's drives keep theirs (drivers/vendors)."""

import math
from typing import Final

from design.motor import PmsmParameters, Transform
from drivers.canopen.objects301 import Cia301
from drivers.vendors.families import motor_objects_for
from virtual_bus.device.object_dictionary import ObjectDictionary
from virtual_bus.drive.shown import show_instead

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
    for _, known in motor_objects_for(int(vendor), int(product), text):
        held = [dictionary.get(each.index, each.sub) for each in known.objects]
        if known.whole and None in held:
            continue
        for each, variable in zip(known.objects, held, strict=True):
            raw = each.raw(figures[each.quantity])
            if variable is None:
                continue
            if each.index >= _PROFILE:
                show_instead(variable, raw)
            else:
                variable.default = variable.value = raw


def motor_figures(motor: PmsmParameters) -> dict[str, float]:
    """By quantity of :data:`drivers.vendors.motor_objects.QUANTITIES`."""
    per_rms = math.sqrt(3.0 if motor.transform is Transform.POWER_INVARIANT else 2.0)
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
