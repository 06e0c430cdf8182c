"""Currents of the least amplitude for a torque, and torque with a weakened field, of constant inductances.

With di = L_q - L_d the torque is k n_p (phi - di i_d) i_q; of all currents of an amplitude I it is largest at

    i_d = (phi - sqrt(phi^2 + 8 di^2 I^2)) / (4 di)

Above the speed at which the voltage is all used, the flux has to fit it: |psi| <= V / w, R left out.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.design.motor import PmsmParameters

Array = NDArray[np.float64]

_HALVINGS: Final = 80
_ANGLES: Final = 4001
"""Directions of the current vector, from i_d < 0 alone over i_q alone to i_d > 0."""
FASTEST: Final = 4.0
"""Multiple of the speed without load that no weakened field goes beyond: iron and bearings have ends too."""


def field_torque(motor: PmsmParameters, current_d_a: float, current_q_a: float) -> float:
    """N m."""
    flux = motor.flux_linkage_wb + (motor.inductance_d_h - motor.inductance_q_h) * current_d_a
    return motor.torque_factor * motor.pole_pairs * flux * current_q_a


def best_angle(motor: PmsmParameters, amplitude_a: float) -> tuple[float, float]:
    """d and q current of the largest torque of that amplitude."""
    more = motor.inductance_q_h - motor.inductance_d_h
    if more == 0.0:
        return 0.0, amplitude_a
    flux = motor.flux_linkage_wb
    current_d = (flux - math.sqrt(flux * flux + 8.0 * more * more * amplitude_a * amplitude_a)) / (4.0 * more)
    return current_d, math.sqrt(max(0.0, amplitude_a * amplitude_a - current_d * current_d))


def largest_torque(motor: PmsmParameters) -> float:
    """N m at ``current_max_a``."""
    return field_torque(motor, *best_angle(motor, motor.current_max_a))


def least_currents(motor: PmsmParameters, torque_nm: float) -> tuple[float, float]:
    """d and q current of the least amplitude for ``torque_nm`` >= 0, up to ``current_max_a``."""
    low, high = 0.0, motor.current_max_a
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        enough = field_torque(motor, *best_angle(motor, middle)) >= torque_nm
        low, high = (low, middle) if enough else (middle, high)
    return best_angle(motor, high)


def weakened_torque_limit(motor: PmsmParameters, speed_rad_s: Array) -> Array:
    """Return the largest torque (k,) in N m at k speeds >= 0 with any d current inside circle and ellipse."""
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, _ANGLES)
    limits = [_torque_at(motor, float(speed), angle) for speed in speed_rad_s]
    return np.asarray(limits)


def _torque_at(motor: PmsmParameters, speed_rad_s: float, angle: Array) -> float:
    """Along each direction of the current the torque grows up to the nearer of circle and ellipse, if the
    ellipse begins inside the circle."""
    unit_d, unit_q = np.sin(angle), np.cos(angle)
    flux, ohm = motor.flux_linkage_wb, motor.resistance_ohm
    omega = motor.pole_pairs * speed_rad_s
    # |v|^2 = a I^2 + 2 b I + c along a direction
    v_d, v_q = (
        ohm * unit_d - omega * motor.inductance_q_h * unit_q,
        ohm * unit_q + omega * motor.inductance_d_h * unit_d,
    )
    a, b = v_d**2 + v_q**2, v_q * omega * flux
    left = motor.voltage_max_v**2 - (omega * flux) ** 2
    inside = b * b + a * left
    root = np.sqrt(np.maximum(inside, 0.0))
    begins, ends = (-b - root) / a, (-b + root) / a
    there = (inside >= 0.0) & (ends > 0.0) & (begins <= motor.current_max_a)
    amplitude = np.where(there, np.minimum(ends, motor.current_max_a), 0.0)
    torque = [
        field_torque(motor, float(size * d), float(size * q))
        for size, d, q in zip(amplitude, unit_d, unit_q, strict=True)
    ]
    return max(0.0, *torque)


def weakened_speed(motor: PmsmParameters) -> float:
    """The largest speed without load, rad/s, with all of the current against the magnet."""
    no_load = motor.voltage_max_v / (motor.pole_pairs * motor.flux_linkage_wb)
    left = motor.flux_linkage_wb - motor.inductance_d_h * motor.current_max_a
    if left * FASTEST <= motor.flux_linkage_wb:
        return FASTEST * no_load
    return no_load * motor.flux_linkage_wb / left
