"""What a simulated drive makes of a torque, into the core: virtual_bus/core/field.h."""

from array import array
from dataclasses import dataclass
from typing import Final

from servobench.design.field import largest_torque, least_currents, weakened_speed
from servobench.design.motor import PmsmParameters
from servobench.virtual_bus.core.native import InnerLoops

_POINTS: Final = 65
"""Points of the table of d currents over torque, as many as the core has room for."""
_WEAKENING_SHARE: Final = 1.0 / 30.0
"""Bandwidth of the weakening over that of the current loops: a torque step's voltage hardly moves it."""


@dataclass(frozen=True, slots=True)
class FieldOptions:
    """What a drive does besides i_d = 0."""

    least_current: bool = False
    """A d current that makes torque by saliency: the least amplitude for each torque."""
    voltage_share: float = 0.0
    """Share of the voltage circle above which a negative d current weakens the field; 0: never."""


NO_FIELD: Final = FieldOptions()
"""The default of a simulated drive."""


def torque_limit_nm(motor: PmsmParameters, field: FieldOptions) -> float:
    """The largest torque that the drive can ask for."""
    return largest_torque(motor) if field.least_current else motor.torque_max_nm


def speed_without_load_rad_s(motor: PmsmParameters, field: FieldOptions) -> float:
    """The largest speed at which it has voltage left."""
    if field.voltage_share:
        return weakened_speed(motor)
    return motor.voltage_max_v / (motor.pole_pairs * motor.flux_linkage_wb)


def fill_field(inner: InnerLoops, motor: PmsmParameters, field: FieldOptions, current_rad_s: float) -> None:
    """Give ``inner`` the motor as the drive believes it, and what it makes of it.

    ``current_rad_s``: bandwidth of its current loops.
    """
    inner.torque_constant_nm_a = motor.torque_constant_nm_a
    inner.per_torque_constant = 1.0 / motor.torque_constant_nm_a
    inner.believed_flux_wb = motor.flux_linkage_wb
    inner.believed_saliency_h = motor.inductance_d_h - motor.inductance_q_h
    inner.believed_resistance_ohm = motor.resistance_ohm
    inner.believed_inductance_q_h = motor.inductance_q_h
    inner.believed_inertia_kg_m2 = motor.inertia_kg_m2
    if field == NO_FIELD:
        return
    inner.field_active = 1
    inner.field_torque_per_wb = motor.torque_factor * motor.pole_pairs
    floor_a = -min(motor.current_max_a, motor.flux_linkage_wb / motor.inductance_d_h)
    inner.field_floor_a = inner.field_weakest_a = floor_a
    inner.field_voltage_share = field.voltage_share
    inner.field_gain = _WEAKENING_SHARE * current_rad_s * inner.period_s / motor.inductance_d_h
    no_load = motor.voltage_max_v / (motor.pole_pairs * motor.flux_linkage_wb)
    inner.field_speed_min_rad_s = 0.5 * motor.pole_pairs * no_load
    if field.least_current:
        step_nm = torque_limit_nm(motor, field) / (_POINTS - 1)
        currents = [least_currents(motor, point * step_nm)[0] for point in range(_POINTS)]
        inner.field_per_step = 1.0 / step_nm
        inner.field_weakest_a = floor_a - max(0.0, *currents)
        inner.set_least_currents(array("d", currents).tobytes())
