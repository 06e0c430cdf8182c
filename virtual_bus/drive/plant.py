"""A PMSM with its mechanics in the rotor's dq frame: the equations of :mod:`design.motor`, integrated.

Coulomb friction holds a resting shaft until the other torques exceed it. The load torque is an active
one: it acts against positive speed whether the shaft turns or not. The position counts turns without end.
"""

import math

from design.motor import PmsmParameters
from virtual_bus.drive import motor_kernel as kernel
from virtual_bus.drive.motor_kernel import FloatArray

_STEP_ANGLE_MAX = 0.25
"""Largest (R/L + electrical speed) * step, rad: keeps the error of a step below 1e-5 of the signal."""
_OVERSPEED = 2.0
"""The step is chosen for this multiple of the rated speed."""


def fill_machine(p: FloatArray, motor: PmsmParameters, period_s: float) -> None:
    """Write the motor and the number of integration steps per ``period_s`` into ``p``, (PARAMETERS_SIZE,)."""
    p[kernel.P_RESISTANCE] = motor.resistance_ohm
    p[kernel.P_INDUCTANCE_D] = motor.inductance_d_h
    p[kernel.P_INDUCTANCE_Q] = motor.inductance_q_h
    p[kernel.P_FLUX] = motor.flux_linkage_wb
    p[kernel.P_POLE_PAIRS] = motor.pole_pairs
    p[kernel.P_TORQUE_FACTOR] = motor.torque_factor
    p[kernel.P_INERTIA] = motor.inertia_kg_m2
    p[kernel.P_VISCOUS] = motor.viscous_friction_nm_s
    p[kernel.P_COULOMB] = motor.coulomb_friction_nm
    p[kernel.P_VOLTAGE_MAX] = motor.voltage_max_v
    p[kernel.P_PER_INDUCTANCE_D] = 1.0 / motor.inductance_d_h
    p[kernel.P_PER_INDUCTANCE_Q] = 1.0 / motor.inductance_q_h
    p[kernel.P_PER_INERTIA] = 1.0 / motor.inertia_kg_m2
    p[kernel.P_PERIOD] = period_s
    fastest_rad_s = motor.resistance_ohm / min(motor.inductance_d_h, motor.inductance_q_h)
    fastest_rad_s += _OVERSPEED * motor.pole_pairs * motor.rated_speed_rad_s
    substeps = max(1, math.ceil(period_s * fastest_rad_s / _STEP_ANGLE_MAX))
    p[kernel.P_SUBSTEPS] = substeps
    p[kernel.P_STEP] = period_s / substeps
    p[kernel.P_RATE] = 1.0 / period_s
    p[kernel.P_TORQUE_CONSTANT] = motor.torque_constant_nm_a
    p[kernel.P_PER_TORQUE_CONSTANT] = 1.0 / motor.torque_constant_nm_a
