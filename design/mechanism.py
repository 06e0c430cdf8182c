"""Machine around a motor's rotor: coupling, backlash, friction, cogging, a load by its place, switches.

Two masses J_m and J_l, a coupling with stiffness k and damping d in its twist p beyond the backlash:

    J_m domega_m/dt = T_e - k p - d dp/dt        antiresonance  w_a^2 = k / J_l
    J_l domega_l/dt = k p + d dp/dt - T_load     resonance      w_r^2 = k (1 / J_m + 1 / J_l)

From motor torque to motor speed the load is a notch at w_a, and the rotor swings freely at w_r.
"""

import math
from dataclasses import dataclass, replace
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
    second_encoder: bool = False
    """The other side has one too, which is told and not controlled by."""

    @property
    def antiresonance_hz(self) -> float:
        """At which the load swings while the rotor rests."""
        return math.sqrt(self.stiffness_nm_rad / self.load_kg_m2) / math.tau

    @property
    def resonance_hz(self) -> float:
        """At which both masses swing against each other."""
        return self.antiresonance_hz * math.sqrt(1.0 + self.load_kg_m2 / self.motor_kg_m2)

    def with_resonance(self, share: float) -> "Coupling":
        """The same with both frequencies so many times as high."""
        return replace(self, stiffness_nm_rad=share**2 * self.stiffness_nm_rad)

    def scaled(self, share: float) -> "Coupling":
        """The same spring between masses that are so many times as large."""
        larger = replace(self, motor_kg_m2=share * self.motor_kg_m2, load_kg_m2=share * self.load_kg_m2)
        return replace(larger, damping_ratio=self.damping_ratio / math.sqrt(share))

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
    load_share: float = 0.0
    """Coulomb friction, of both ways, that each N m of the load torque adds: a gear's."""
    bristle_nm_rad: float = 0.0
    """Stiffness of bristles that bend before they slip (LuGre); 0: friction goes by the speed alone."""
    bristle_damping_ratio: float = 1.0
    """Of the oscillation, on its bristles, of the mass that rubs."""

    def bristle_nm_s(self, rubbed_kg_m2: float) -> float:
        """Damping of the bristles, N m per rad/s, of a mass with that inertia."""
        return 2.0 * self.bristle_damping_ratio * math.sqrt(self.bristle_nm_rad * rubbed_kg_m2)


@dataclass(frozen=True, slots=True)
class CoggingHarmonic:
    """amplitude sin(order angle + phase), N m onto the rotor."""

    per_turn: int
    torque_nm: float
    phase_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Arm:
    """A weight on an arm: torque sin(angle) against positive speed, of an arm that hangs down at 0."""

    torque_nm: float
    """At the motor, of an arm that lies level."""
    ratio: float = 1.0
    """Turns of the motor for one of the arm."""
    phase_rad: float = 0.0
    """Angle of the arm at power-on."""

    @property
    def stiffness_nm_rad(self) -> float:
        """At the motor, of an arm that hangs down; one that stands up has the same below 0."""
        return self.torque_nm / self.ratio


@dataclass(frozen=True, slots=True)
class LoadMap:
    """Torque over place and speed: straight between points, held beyond the last ones."""

    turns: tuple[float, ...]
    """Places (n,), of the motor since power-on, rising."""
    speeds_rad_s: tuple[float, ...]
    """Speeds (m,), rising."""
    torques_nm: tuple[tuple[float, ...], ...]
    """(n, m), against positive speed."""
    repeats: bool = False
    """The last place is the first again."""


@dataclass(frozen=True, slots=True)
class EndStops:
    """A spring with a damper at either end of the way; it pushes and never pulls."""

    negative_turns: float | None
    """Where the load touches it, turns of the motor since power-on; None: no stop there."""
    positive_turns: float | None
    stiffness_nm_rad: float
    damping_ratio: float
    """Damping of the load's oscillation on the stop."""

    def damping_nm_s(self, load_kg_m2: float) -> float:
        """N m per rad/s, of a load with that inertia."""
        return 2.0 * self.damping_ratio * math.sqrt(self.stiffness_nm_rad * load_kg_m2)


@dataclass(frozen=True, slots=True)
class Switches:
    """Switches beside the axis, turns of the motor since power-on; None: not fitted."""

    negative_turns: float | None = None
    """Active here and below."""
    positive_turns: float | None = None
    """Active here and above."""
    home_turns: tuple[float, float] | None = None
    """Active from the first to the second."""
    bounce_s: float = 0.0
    """From the crossing of an edge until the contact rests."""
    bounces: int = 3
    """In that time; the contact changes twice in each."""
    filter_s: float = 0.0
    """Filter of the drive's inputs: a change that lasts shorter is not seen."""
    swapped: bool = False
    """Each limit switch is wired to the input of the other."""


@dataclass(frozen=True, slots=True)
class PlacedLoad:
    """Torque that a load asks of the shaft by its place and its speed."""

    hanging_nm: float = 0.0
    """Torque of a weight on a rope: the same everywhere, against positive speed."""
    arm: Arm | None = None
    table: LoadMap | None = None
    stops: EndStops | None = None

    @property
    def of_its_place(self) -> tuple[str, ...]:
        """Parts that change with place or speed, by their keys in a file: a linear model has none of them."""
        parts = {"arm": self.arm, "table": self.table, "end_stops": self.stops}
        return tuple(name for name, part in parts.items() if part is not None)


@dataclass(frozen=True, slots=True)
class Mechanism:
    """What of it there is."""

    coupling: Coupling | None = None
    friction: Friction | None = None
    cogging: tuple[CoggingHarmonic, ...] = ()
    load: PlacedLoad | None = None
    switches: Switches | None = None
    cogging_points_nm: tuple[float, ...] = ()
    """Instead of harmonics: torque at angles that divide a turn evenly, from 0 on, straight between them."""

    def load_kg_m2(self, inertia_kg_m2: float) -> float:
        """Inertia behind the coupling; without one, all of it."""
        return inertia_kg_m2 if self.coupling is None else self.coupling.load_kg_m2

    def rubbed_kg_m2(self, inertia_kg_m2: float) -> float:
        """Inertia of the mass that the friction acts on."""
        if self.coupling is None or self.friction is None:
            return inertia_kg_m2
        shaft = self.coupling
        return shaft.load_kg_m2 if self.friction.side is Side.LOAD else shaft.motor_kg_m2

    def fastest_hz(self, inertia_kg_m2: float) -> float:
        """The highest frequency at which something swings, over the coupling, on an end stop or on bristles;
        0: none."""
        stops = None if self.load is None else self.load.stops
        load_nm_rad = 0.0 if stops is None else stops.stiffness_nm_rad
        rotor_nm_rad = 0.0
        if self.friction is not None and self.friction.side is Side.LOAD:
            load_nm_rad += self.friction.bristle_nm_rad
        elif self.friction is not None:
            rotor_nm_rad = self.friction.bristle_nm_rad
        shaft = self.coupling
        if shaft is None:
            square = (load_nm_rad + rotor_nm_rad) / inertia_kg_m2
        else:
            square = (shaft.stiffness_nm_rad + load_nm_rad) / shaft.load_kg_m2
            square += (shaft.stiffness_nm_rad + rotor_nm_rad) / shaft.motor_kg_m2
        return math.sqrt(square) / math.tau


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


def cogging_nm(mechanism: Mechanism, angle_rad: Array) -> Array:
    """The torque (k,) in N m at k angles of the rotor."""
    points = mechanism.cogging_points_nm
    if points:
        return np.interp(angle_rad / math.tau * len(points), np.arange(len(points) + 1), (*points, points[0]))
    total = np.zeros_like(angle_rad)
    for each in mechanism.cogging:
        total += each.torque_nm * np.sin(each.per_turn * angle_rad + each.phase_rad)
    return total
