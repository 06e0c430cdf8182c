"""The two sampled current loops of a PMSM together, at a constant speed, with their coupling.

Within a period the inverter's voltage stands still in the stator's frame, so it turns backwards in the
rotor's. It is computed from the samples at k, put out from k + delay on, and turned forward by ``advance``
periods of rotation (Park's angle advance). Decoupling adds -w L_q i_q and +w L_d i_d of the drive's own
parameters to the controllers' voltages; the magnets' voltage is a disturbance and moves no pole.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from servobench.design.current.current_loop import lowest_rate
from servobench.design.hinf.bilinear import tustin
from servobench.design.motor import PmsmParameters
from servobench.design.statespace import Array, StateSpace, append

_J = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Decoupling:
    """The drive's model: the inductances it decouples with, H, and its angle advance, periods."""

    inductance_d_h: float
    inductance_q_h: float
    advance_periods: float


def nominal_decoupling(motor: PmsmParameters, delay_samples: int) -> Decoupling:
    """Return right parameters, and the angle at the middle of the period in which the voltage acts."""
    return Decoupling(motor.inductance_d_h, motor.inductance_q_h, delay_samples + 0.5)


def rotation(angle_rad: float) -> Array:
    """Return the (2, 2) rotation by ``angle_rad``."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def dq_matrix(motor: PmsmParameters, electrical_rad_s: float) -> tuple[Array, Array]:
    """Return A and B of d[i_d, i_q]/dt at a constant electrical speed; voltages in the rotor's frame."""
    R, Ld, Lq = motor.resistance_ohm, motor.inductance_d_h, motor.inductance_q_h
    A = np.array([[-R / Ld, electrical_rad_s * Lq / Ld], [-electrical_rad_s * Ld / Lq, -R / Lq]])
    return A, np.diag([1.0 / Ld, 1.0 / Lq])


def closed_loop_matrix(
    motor: PmsmParameters,
    K_d: StateSpace,
    K_q: StateSpace,
    speed_rad_s: float,
    decoupling: Decoupling | None,
    delay_samples: int = 1,
) -> Array:
    """Return the transition matrix over one period of [i, waiting voltages, K_d's and K_q's states].

    ``speed_rad_s`` is mechanical; ``decoupling`` None: neither decoupling nor angle advance.
    """
    K = append(K_d, K_q)
    period_s = K.period_s
    if period_s is None:
        raise ValueError("sampled controllers are expected: discretise them first")
    electrical = motor.pole_pairs * speed_rad_s
    A, B = dq_matrix(motor, electrical)
    joint = np.block([[A, B], [np.zeros((2, 2)), -electrical * _J]])
    grown = scipy.linalg.expm(joint * period_s)
    ahead = decoupling.advance_periods if decoupling else 0.0
    turned = rotation((ahead - delay_samples) * electrical * period_s)
    Phi, Gamma = grown[:2, :2], grown[:2, 2:] @ turned
    cross = np.zeros((2, 2))
    if decoupling:
        cross = electrical * np.array([[0.0, -decoupling.inductance_q_h], [decoupling.inductance_d_h, 0.0]])
    voltage_of_current = cross - K.D
    waiting = 2 * delay_samples
    n = 2 + waiting + K.order
    M = np.zeros((n, n))
    M[:2, :2] = Phi
    M[2 + waiting :, :2] = -K.B
    M[2 + waiting :, 2 + waiting :] = K.A
    if delay_samples == 0:
        M[:2, :2] += Gamma @ voltage_of_current
        M[:2, 2:] = Gamma @ K.C
        return M
    M[:2, 2:4] = Gamma
    M[2:waiting, 4 : 2 + waiting] = np.eye(waiting - 2)
    M[waiting : 2 + waiting, :2] = voltage_of_current
    M[waiting : 2 + waiting, 2 + waiting :] = K.C
    return M


def lowest_coupled_rate_hz(
    motor: PmsmParameters,
    K_d: StateSpace,
    K_q: StateSpace,
    crossovers_rad_s: tuple[float, float],
    speed_max_rad_s: float,
    delay_samples: int,
) -> float | None:
    """Return the lowest rate, to 1 %, at and above which Tustin's ``K_d`` and ``K_q`` are stable up to that
    speed.

    With right decoupling and angle advance, seen at six speeds. None: not even at ``RATE_MAX_HZ``.
    """
    speeds = np.linspace(0.0, speed_max_rad_s, 6)
    decoupling = nominal_decoupling(motor, delay_samples)

    def holds(rate_hz: float) -> bool:
        if rate_hz <= 1.05 * max(crossovers_rad_s) / np.pi:
            return False
        d, q = (tustin(K, rate_hz, at) for K, at in zip((K_d, K_q), crossovers_rad_s, strict=True))
        return bool(spectral_radius(motor, d, q, speeds, decoupling, delay_samples).max() < 1.0)

    return lowest_rate(holds, 0.01)


def spectral_radius(
    motor: PmsmParameters,
    K_d: StateSpace,
    K_q: StateSpace,
    speeds_rad_s: Array,
    decoupling: Decoupling | None,
    delay_samples: int = 1,
) -> Array:
    """Return the (k,) largest pole magnitude of the coupled loops at the k mechanical speeds, rad/s."""
    radii = [
        np.abs(
            np.linalg.eigvals(closed_loop_matrix(motor, K_d, K_q, float(speed), decoupling, delay_samples))
        ).max()
        for speed in speeds_rad_s
    ]
    return np.array(radii)
