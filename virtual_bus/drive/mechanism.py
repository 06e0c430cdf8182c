"""What is between rotor and load, into the core: :mod:`servobench.design.mechanism` in the core's numbers.

What a simulated drive makes of a torque, into the core: virtual_bus/core/field.h.
"""

import math
from array import array
from dataclasses import dataclass
from typing import Final

from servobench.design.field import largest_torque, least_currents, weakened_speed
from servobench.design.mechanism import (
    CoggingHarmonic,
    Coupling,
    EndStops,
    Friction,
    LoadMap,
    Mechanism,
    PlacedLoad,
    Side,
    Switches,
)
from servobench.design.motor import PmsmParameters
from servobench.virtual_bus.core.native import InnerLoops, sine_cosine

STEP_ANGLE_MAX: Final = 0.1
"""Largest resonance * step, rad: at the bound an undamped oscillation is 7e-5 off after 800 steps."""
_POINTS_PER_PERIOD: Final = 64
"""Of the highest cogging harmonic; straight lines between them are 1.2e-3 of its amplitude off."""


def fill_mechanism(inner: InnerLoops, motor: PmsmParameters, mechanism: Mechanism) -> None:
    """Give ``inner`` what the motor turns and how; to be called where its friction is set."""
    inner.mechanism = mechanism != Mechanism(switches=mechanism.switches)
    inner.per_inertia_rotor = 1.0 / motor.inertia_kg_m2
    if mechanism.coupling is not None:
        _couple(inner, mechanism.coupling)
    if mechanism.friction is not None:
        _rub(inner, motor, mechanism.friction)
        inner.bristle_nm_s = mechanism.friction.bristle_nm_s(mechanism.rubbed_kg_m2(motor.inertia_kg_m2))
    if mechanism.cogging_points_nm:
        points = mechanism.cogging_points_nm
        inner.set_cogging(array("d", (*points, points[0])).tobytes())
    elif mechanism.cogging:
        inner.set_cogging(cogging_table(mechanism.cogging))
    if mechanism.switches is not None:
        _switch(inner, mechanism.switches)
    if mechanism.load is not None:
        _load(inner, mechanism.load)
        if mechanism.load.stops is not None:
            _stop(inner, mechanism.load.stops, mechanism.load_kg_m2(motor.inertia_kg_m2))


def steps_in(period_s: float, mechanism: Mechanism, inertia_kg_m2: float) -> int:
    """How many steps of integration a period takes for the sake of what can swing, 1 at least."""
    angle = period_s * math.tau * mechanism.fastest_hz(inertia_kg_m2)
    return max(1, math.ceil(angle / STEP_ANGLE_MAX))


def _couple(inner: InnerLoops, coupling: Coupling) -> None:
    inner.coupled = 1
    inner.encoder_on_load = coupling.encoder is Side.LOAD
    inner.per_inertia_rotor = 1.0 / coupling.motor_kg_m2
    inner.per_inertia_load = 1.0 / coupling.load_kg_m2
    inner.stiffness_nm_rad = coupling.stiffness_nm_rad
    inner.damping_nm_s = coupling.damping_nm_s
    inner.half_backlash_rad = 0.5 * coupling.backlash_rad
    inner.yield_s = coupling.damping_nm_s / coupling.stiffness_nm_rad


def _rub(inner: InnerLoops, motor: PmsmParameters, friction: Friction) -> None:
    inner.friction_on_load = friction.side is Side.LOAD
    inner.rubs_per_load = friction.load_share
    inner.bristle_nm_rad = friction.bristle_nm_rad
    inner.backward_more_nm = friction.backward_nm - motor.coulomb_friction_nm
    inner.breakaway_more_nm = friction.breakaway_nm - motor.coulomb_friction_nm
    inner.per_stribeck = 1.0 / friction.stribeck_rad_s


def _load(inner: InnerLoops, load: PlacedLoad) -> None:
    inner.hanging_nm = load.hanging_nm
    if load.arm is not None:
        inner.arm_nm = load.arm.torque_nm
        inner.arm_per_turn, inner.arm_turns = 1.0 / load.arm.ratio, load.arm.phase_rad / math.tau
    if load.table is not None:
        _tabulate(inner, load.table)
    inner.placed_load = load.hanging_nm != 0.0 or load.arm is not None or load.table is not None


def _tabulate(inner: InnerLoops, table: LoadMap) -> None:
    rows = (torque_nm for row in table.torques_nm for torque_nm in row)
    octets = array("d", (*table.turns, *table.speeds_rad_s, *rows)).tobytes()
    inner.set_load_table(len(table.turns), len(table.speeds_rad_s), octets)
    inner.repeats_turns = table.turns[-1] - table.turns[0] if table.repeats else 0.0


def _stop(inner: InnerLoops, stops: EndStops, load_kg_m2: float) -> None:
    inner.stop_negative_turns = -math.inf if stops.negative_turns is None else stops.negative_turns
    inner.stop_positive_turns = math.inf if stops.positive_turns is None else stops.positive_turns
    inner.stop_stiffness_nm_rad = stops.stiffness_nm_rad
    inner.stop_damping_nm_s = stops.damping_nm_s(load_kg_m2)
    inner.stop_yield_s = inner.stop_damping_nm_s / stops.stiffness_nm_rad
    inner.end_stops = 1


def _switch(inner: InnerLoops, switches: Switches) -> None:
    inner.switch_bounce_s, inner.switch_bounces = switches.bounce_s, switches.bounces
    inner.switch_filter_s = switches.filter_s
    inner.switches = switches.bounce_s > 0.0 or switches.filter_s > 0.0


def cogging_table(harmonics: tuple[CoggingHarmonic, ...]) -> bytes:
    """Torque over a turn, N m, its first point once more at the end; the same bits everywhere."""
    points = _POINTS_PER_PERIOD * max(harmonic.per_turn for harmonic in harmonics)
    table = array("d")
    for point in range(points):
        torque_nm = 0.0
        for harmonic in harmonics:
            turns = harmonic.per_turn * point % points / points
            torque_nm += harmonic.torque_nm * sine_cosine(math.tau * turns + harmonic.phase_rad)[0]
        table.append(torque_nm)
    table.append(table[0])
    return table.tobytes()


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
