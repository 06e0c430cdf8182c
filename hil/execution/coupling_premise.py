"""Whether a bench's machine has the coupling, and the load, that the certificate of its controller has."""

from collections.abc import Iterator
from typing import Final

from servobench.design.mechanism import Mechanism, Side
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.configuration.controller_files import DesignCoupling

_RELATIVE: Final = 1e-6
"""A file's figures have at least so many digits."""


def flexible(axis: str, drive: DriveConfig, simulated: bool) -> Iterator[str]:
    """Yield what of coupling and load is otherwise than a certificate has it."""
    motor, key = drive.motor, f"drive.{axis}.motor"
    if simulated and drive.simulation.motor is not None:
        motor, key = drive.simulation.motor, f"drive.{axis}.simulation.motor"
    mechanism = motor.parameters.mechanism or Mechanism()
    if mechanism.load is not None and mechanism.load.of_its_place:
        parts = ", ".join(mechanism.load.of_its_place)
        yield f"{key}.load: {parts}, expected a load torque that no place or speed changes"
    made_for = getattr(drive.controller, "made_for", None)
    known = None if made_for is None or made_for.plant is None else made_for.plant.coupling
    if mechanism.coupling is not None:
        yield from _other(f"{key}.coupling", mechanism, known)
    elif known is not None:
        yield f"{key}: a rigid shaft, expected a coupling with its resonance at {known.resonance_hz:.3g} Hz"


def _other(key: str, mechanism: Mechanism, known: DesignCoupling | None) -> Iterator[str]:
    shaft = mechanism.coupling
    assert shaft is not None
    if known is None:
        yield f"{key}: resonance at {shaft.resonance_hz:.3g} Hz, expected a rigid shaft"
        return
    if shaft.backlash_rad:
        yield f"{key}.backlash_rad: {shaft.backlash_rad:g}, expected no play"
    friction = Side.MOTOR if mechanism.friction is None else mechanism.friction.side
    for name, side, expected in (
        ("encoder", shaft.encoder.value, known.encoder),
        ("friction", friction.value, known.friction),
    ):
        if side != expected:
            yield f"{key}: {name} on the side of the {side}, expected the {expected}"
    for name in ("motor_kg_m2", "load_kg_m2", "stiffness_nm_rad", "damping_nm_s"):
        value, of_design = getattr(shaft, name), getattr(known, name)
        if abs(value - of_design) > _RELATIVE * abs(of_design):
            yield f"{key}: {name} = {value:.6g}, expected {of_design:.6g}"
