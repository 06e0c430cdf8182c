"""What is between rotor and load, into the core: :mod:`servobench.design.mechanism` in the core's numbers."""

import math
from array import array
from typing import Final

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
    if mechanism.cogging:
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
