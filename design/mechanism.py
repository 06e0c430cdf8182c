"""What is between a motor's rotor and its load, and holds them: coupling, backlash, friction, cogging.

Two masses J_m and J_l, a coupling with stiffness k and damping d in its twist p beyond the backlash:

    J_m domega_m/dt = T_e - k p - d dp/dt        antiresonance  w_a^2 = k / J_l
    J_l domega_l/dt = k p + d dp/dt - T_load     resonance      w_r^2 = k (1 / J_m + 1 / J_l)

From motor torque to motor speed the load is a notch at w_a, and the rotor swings freely at w_r.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


class Side(Enum):
    """Of a coupling."""

    MOTOR = "motor"
    LOAD = "load"


@dataclass(frozen=True, slots=True)
class Coupling:
    """Two masses that are the inertia of the motor's file together."""

    motor_kg_m2: float
    load_kg_m2: float
    stiffness_nm_rad: float
    damping_ratio: float
    """Of the free oscillation of both masses against each other."""
    backlash_rad: float = 0.0
    """From one flank to the other."""
    encoder: Side = Side.MOTOR

    @property
    def antiresonance_hz(self) -> float:
        """At which the load swings while the rotor rests."""
        return math.sqrt(self.stiffness_nm_rad / self.load_kg_m2) / math.tau

    @property
    def resonance_hz(self) -> float:
        """At which both masses swing against each other."""
        return self.antiresonance_hz * math.sqrt(1.0 + self.load_kg_m2 / self.motor_kg_m2)

    @property
    def damping_nm_s(self) -> float:
        """d, N m per rad/s."""
        reduced = self.motor_kg_m2 * self.load_kg_m2 / (self.motor_kg_m2 + self.load_kg_m2)
        return 2.0 * self.damping_ratio * math.tau * self.resonance_hz * reduced


@dataclass(frozen=True, slots=True)
class Friction:
    """Beside Coulomb and viscous friction: (c + (b - c) / (1 + (w / w_s)^2)) sign w at the speed w."""

    breakaway_nm: float
    """b; at least the Coulomb friction of either way."""
    stribeck_rad_s: float
    """w_s: there half of what a start takes more is gone."""
    backward_nm: float
    """c at negative speed; that of the mechanics is at positive."""
    side: Side = Side.MOTOR


@dataclass(frozen=True, slots=True)
class CoggingHarmonic:
    """amplitude sin(order angle + phase), N m onto the rotor."""

    per_turn: int
    torque_nm: float
    phase_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Mechanism:
    """What of it there is."""

    coupling: Coupling | None = None
    friction: Friction | None = None
    cogging: tuple[CoggingHarmonic, ...] = ()


def friction_nm(friction: Friction, coulomb_nm: float, viscous_nm_s: float, speed_rad_s: Array) -> Array:
    """The friction torque (k,) in N m at k speeds that are not zero; ``coulomb_nm``: c at positive speed."""
    coulomb = np.where(speed_rad_s > 0.0, coulomb_nm, friction.backward_nm)
    more = (friction.breakaway_nm - coulomb_nm) / (1.0 + (speed_rad_s / friction.stribeck_rad_s) ** 2)
    return (coulomb + more) * np.sign(speed_rad_s) + viscous_nm_s * speed_rad_s


def speed_responses(coupling: Coupling, frequency_hz: Array) -> tuple[Complex, Complex]:
    """From motor torque to the speed of motor and of load, rad/s per N m, (k,) each; without play and
    friction."""
    s = 2j * math.pi * frequency_hz
    spring = coupling.stiffness_nm_rad + coupling.damping_nm_s * s
    motor, load = coupling.motor_kg_m2 * s * s + spring, coupling.load_kg_m2 * s * s + spring
    below = motor * load - spring * spring
    return s * load / below, s * spring / below


def cogging_nm(harmonics: Iterable[CoggingHarmonic], angle_rad: Array) -> Array:
    """The torque (k,) in N m at k angles of the rotor."""
    total = np.zeros_like(angle_rad)
    for each in harmonics:
        total += each.torque_nm * np.sin(each.per_turn * angle_rad + each.phase_rad)
    return total
