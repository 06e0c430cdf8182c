"""What is between rotor and load, into the core: :mod:`servobench.design.mechanism` in the core's numbers."""

import math
from array import array
from typing import Final

from servobench.design.mechanism import CoggingHarmonic, Coupling, Friction, Mechanism, Side
from servobench.design.motor import PmsmParameters
from servobench.virtual_bus.core.native import InnerLoops, sine_cosine

STEP_ANGLE_MAX: Final = 0.1
"""Largest resonance * step, rad: at the bound an undamped oscillation is 7e-5 off after 800 steps."""
_POINTS_PER_PERIOD: Final = 64
"""Of the highest cogging harmonic; straight lines between them are 1.2e-3 of its amplitude off."""


def fill_mechanism(inner: InnerLoops, motor: PmsmParameters, mechanism: Mechanism) -> None:
    """Give ``inner`` what the motor turns and how; to be called where its friction is set."""
    inner.mechanism = 1
    inner.per_inertia_rotor = 1.0 / motor.inertia_kg_m2
    if mechanism.coupling is not None:
        _couple(inner, mechanism.coupling)
    if mechanism.friction is not None:
        _rub(inner, motor, mechanism.friction)
    if mechanism.cogging:
        inner.set_cogging(cogging_table(mechanism.cogging))


def steps_in(period_s: float, mechanism: Mechanism) -> int:
    """How many steps of integration a period takes for the sake of the coupling."""
    if mechanism.coupling is None:
        return 1
    return math.ceil(period_s * math.tau * mechanism.coupling.resonance_hz / STEP_ANGLE_MAX)


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
