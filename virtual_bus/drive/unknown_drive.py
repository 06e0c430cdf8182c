"""A simulated drive that nobody has described: motor, load and units drawn from a seed, some told wrong.

It stands in for the drive that somebody unpacks. Its :class:`Truth` is for whoever checks the commissioning;
the commissioning side sees the bus and the nameplate, and nothing else.

    drawn           rating, inertia, friction, electrical data, encoder, gear, feed, unit words
    turned round    607Eh says one thing and the wiring another: positive torque may turn either value down
    told wrong      608Fh, 6091h, 60A9h, 6096h or 6076h shows another value than the one in force
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from servobench.design.motor import PmsmParameters, Transform, motor_figures
from servobench.drivers.cia402.objects402 import Object, Unit, unit_word
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.drive.power_stage import current_per_rms
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.user_units import POSITION_POLARITY, VELOCITY_POLARITY

_COUNTS: Final = (4000, 4096, 8192, 10_000, 16_384, 65_536, 131_072, 1_048_576)
"""Per turn: encoders of 1000, 1024, 2048 and 2500 lines, and of 14 to 20 bits."""
_RATIOS: Final = (0.1, 0.25, 0.5, 2.0, 4.0, 10.0)
"""By what a factor is told wrong: a decade, the four edges of an encoder line, a factor of two."""
_GEARS: Final = ((1, 1), (3, 1), (5, 1), (10, 1), (25, 2), (100, 7))
"""None, planetary gears, and two whose ratio is no whole number."""


@dataclass(frozen=True, slots=True)
class Truth:
    """The drawn values; SI units at the motor's shaft."""

    motor: PmsmParameters
    counts_per_revolution: int
    position_rad: float
    """rad of the motor shaft per position unit in force; always positive."""
    velocity_rad_s: float
    rated_torque_nm: float
    position_sign: int
    """-1: positive torque turns the position down, as the drive is delivered."""
    velocity_sign: int
    faults: frozenset[str]
    """Among position, velocity, torque: told wrong; polarity: a sign is turned."""
    clock_drift_ppm: float

    @property
    def nameplate(self) -> dict[str, Any]:
        """Data printed on motor and drive, as tables of a nameplate file."""
        return nameplate_of(self.motor)


def nameplate_of(motor: PmsmParameters) -> dict[str, Any]:
    """Return the data printed on a motor, as tables of a nameplate file."""
    return {
        "motor": {
            "name": motor.name,
            "resistance_ohm": motor.resistance_ohm,
            "inductance_d_h": motor.inductance_d_h,
            "inductance_q_h": motor.inductance_q_h,
            "pole_pairs": motor.pole_pairs,
            "ke_line_vrms_krpm": float(f"{motor_figures(motor)['ke_line_vrms_krpm']:.4g}"),
        },
        "rating": {
            "torque_nm": round(motor.rated_torque_nm, 3),
            "speed_rpm": round(motor.rated_speed_rad_s / RAD_S_PER_RPM),
            "current_a": round(motor.rated_current_a / current_per_rms(motor), 3),
            "dc_bus_voltage_v": motor.dc_bus_voltage_v,
        },
    }


def unknown_drive(
    seed: int, node_id: int = 1, drive: DriveParameters | None = None
) -> tuple[SimulatedServo, Truth]:
    """The drive of a seed, and what is hidden in it. ``drive``: its parameters, the encoder apart."""
    random = np.random.Generator(np.random.PCG64([seed, 0x402]))
    motor = _motor(random, seed)
    counts = int(random.choice(_COUNTS))
    parameters = replace(drive or DriveParameters(), encoder_counts_per_revolution=counts)
    servo = SimulatedServo(node_id, motor, parameters, seed)
    _draw_position_unit(random, servo, counts)
    _draw_velocity_unit(random, servo)
    signs = int(random.integers(4)) << 6
    hidden_signs = int(random.integers(4)) << 6 if random.random() < 0.5 else 0
    servo.drive.units.polarity.default = signs
    faults = _tell_wrong(random, servo)
    if hidden_signs:
        _turn_round(servo.drive.units.polarity, hidden_signs)
        servo.drive.units.polarity.default = signs ^ hidden_signs
    in_force = servo.drive.units.polarity.default
    if in_force:
        faults |= {"polarity"}
    servo.drive.units.polarity.value = in_force
    servo.drive.units.take()
    units = servo.drive.units
    truth = Truth(
        motor=motor,
        counts_per_revolution=counts,
        position_rad=abs(units.counts_per_position) * math.tau / counts,
        velocity_rad_s=abs(units.rad_s_per_velocity),
        rated_torque_nm=servo.drive.objects.rated_torque.default / 1000.0,
        position_sign=-1 if in_force & POSITION_POLARITY else 1,
        velocity_sign=-1 if in_force & VELOCITY_POLARITY else 1,
        faults=frozenset(faults),
        clock_drift_ppm=parameters.clock_drift_ppm,
    )
    return servo, truth


def _motor(random: np.random.Generator, seed: int) -> PmsmParameters:
    """A servo motor with its load, in proportions that occur."""
    torque = _geometric(random, 0.3, 10.0)
    speed = float(random.integers(15, 46)) * 100.0 * RAD_S_PER_RPM
    start_up_s = _geometric(random, 0.03, 0.3)
    pole_pairs = int(random.integers(2, 9))
    bus_v = float(random.choice((48.0, 160.0, 320.0, 560.0)))
    voltage = bus_v / math.sqrt(3.0)
    flux = random.uniform(0.45, 0.65) * voltage / (pole_pairs * speed)
    current = torque / (1.5 * pole_pairs * flux)
    resistance = random.uniform(0.03, 0.08) * voltage / current
    inductance = resistance * random.uniform(0.002, 0.008)
    return PmsmParameters(
        name=f"unknown {seed}",
        resistance_ohm=resistance,
        inductance_d_h=inductance,
        inductance_q_h=inductance * random.uniform(1.0, 1.4),
        flux_linkage_wb=flux,
        pole_pairs=pole_pairs,
        inertia_kg_m2=torque * start_up_s / speed,
        viscous_friction_nm_s=_geometric(random, 0.01, 0.08) * torque / speed,
        coulomb_friction_nm=_geometric(random, 0.01, 0.08) * torque,
        transform=Transform.AMPLITUDE_INVARIANT,
        rated_torque_nm=round(torque, 3),
        rated_speed_rad_s=speed,
        current_max_a=random.uniform(2.0, 3.5) * current,
        dc_bus_voltage_v=bus_v,
    )


def _draw_position_unit(random: np.random.Generator, servo: SimulatedServo, counts: int) -> None:
    """Encoder increments, a feed behind a gear, or a unit word."""
    kind = int(random.integers(3))
    if kind == 0:
        return
    if kind == 1:
        motor_turns, shaft_turns = _GEARS[int(random.integers(len(_GEARS)))]
        feed = round(counts * motor_turns / shaft_turns / random.choice((1, 2, 4)))
        _set(servo, Object.SI_UNIT_POSITION, 0, 0)
        _set(servo, Object.GEAR_RATIO, 1, motor_turns)
        _set(servo, Object.GEAR_RATIO, 2, shaft_turns)
        _set(servo, Object.FEED_CONSTANT, 1, max(2, feed))
        return
    turns = bool(random.integers(2))
    word = unit_word(-5, Unit.REVOLUTION) if turns else unit_word(-3, Unit.DEGREE)
    _set(servo, Object.SI_UNIT_POSITION, 0, word)


def _draw_velocity_unit(random: np.random.Generator, servo: SimulatedServo) -> None:
    words = (
        unit_word(-3, Unit.REVOLUTION, Unit.MINUTE),
        unit_word(-1, Unit.REVOLUTION, Unit.MINUTE),
        unit_word(0, Unit.REVOLUTION_PER_MINUTE),
        unit_word(0, Unit.INCREMENT, Unit.SECOND),
        unit_word(-2, Unit.DEGREE, Unit.SECOND),
        unit_word(-4, Unit.REVOLUTION, Unit.SECOND),
    )
    _set(servo, Object.SI_UNIT_VELOCITY, 0, words[int(random.integers(len(words)))])


def _tell_wrong(random: np.random.Generator, servo: SimulatedServo) -> set[str]:
    """Let some of the factors show another value than the one that rules."""
    faults: set[str] = set()
    word = servo.dictionary.variable(Object.SI_UNIT_POSITION).default
    velocity_word = servo.dictionary.variable(Object.SI_UNIT_VELOCITY).default
    if random.random() < 0.4:
        ratio = _RATIOS[int(random.integers(len(_RATIOS)))]
        if word == 0:
            _show_scaled(servo, Object.FEED_CONSTANT, 1, ratio)
            faults.add("position")
        elif word == unit_word(0, Unit.INCREMENT):
            # An encoder that was set up wrongly: resolution and feed agree with each other.
            _show_scaled(servo, Object.POSITION_ENCODER_RESOLUTION, 1, ratio)
            _show_scaled(servo, Object.FEED_CONSTANT, 1, ratio)
            faults.add("position")
        else:
            exponent = -1 if random.random() < 0.5 else 1
            _show(servo, Object.SI_UNIT_POSITION, 0, word + (exponent << 24) & 0xFFFF_FFFF)
            faults.add("position")
    if random.random() < 0.4:
        exponent = int(random.choice((-2, -1, 1, 2)))
        _show(servo, Object.SI_UNIT_VELOCITY, 0, velocity_word + (exponent << 24) & 0xFFFF_FFFF)
        faults.add("velocity")
    if random.random() < 0.3:
        _show_scaled(servo, Object.MOTOR_RATED_TORQUE, 0, float(random.choice((0.1, 0.5, 2.0, 10.0))))
        faults.add("torque")
    return faults


def _set(servo: SimulatedServo, index: int, sub: int, value: int) -> None:
    variable = servo.dictionary.variable(index, sub)
    variable.default = variable.value = value


def _show(servo: SimulatedServo, index: int, sub: int, value: int) -> None:
    servo.dictionary.variable(index, sub).show_instead(value)


def _show_scaled(servo: SimulatedServo, index: int, sub: int, ratio: float) -> None:
    _show(servo, index, sub, max(2, round(servo.dictionary.variable(index, sub).default * ratio)))


def _turn_round(polarity: Variable, hidden: int) -> None:
    """Wires swapped: the bits that rule are those that are shown, with ``hidden`` turned over."""
    on_write = polarity.on_write

    def written(value: int) -> None:
        polarity.value = value ^ hidden
        if on_write is not None:
            on_write(int(polarity.value))

    polarity.provider = lambda: polarity.value ^ hidden
    polarity.on_write = written


def _geometric(random: np.random.Generator, low: float, high: float) -> float:
    """Drawn evenly on the logarithm."""
    return low * math.exp(math.log(high / low) * random.random())
