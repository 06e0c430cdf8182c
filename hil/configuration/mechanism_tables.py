"""What a motor file may say of what is between rotor and load: ``[coupling]``, ``[friction]`` and
``[[cogging]]``."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from servobench.design.mechanism import CoggingHarmonic, Coupling, Friction, Mechanism, Side
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.quantities import CoulombFriction

Stiffness = Annotated[float, Field(ge=1e-6, le=1e9)]
"""N m/rad"""
RESONANCE_MAX_HZ = 5000.0
"""A simulated period is cut into steps by the resonance: 20 of them at 16 kHz."""


class CouplingTable(Section):
    """``[coupling]``: the inertia of ``[mechanics]`` parted between rotor and load, and the shaft between."""

    inertia_ratio: float = Field(
        default=1.0, ge=1e-3, le=1e3, description="inertia of the load over the rotor's"
    )
    antiresonance_hz: float | None = Field(
        default=None,
        ge=0.1,
        le=RESONANCE_MAX_HZ,
        description="at which the load swings while the rotor rests, Hz",
    )
    stiffness_nm_rad: Stiffness | None = Field(default=None, description="instead of that, N m/rad")
    damping_ratio: float = Field(default=0.02, ge=0.0, le=1.0, description="of both masses' free oscillation")
    backlash_rad: float = Field(default=0.0, ge=0.0, le=1.0, description="play from flank to flank, rad")
    encoder: Literal["motor", "load"] = Field(
        default="motor", description="'motor' or 'load': where the encoder is"
    )

    @model_validator(mode="after")
    def _one_stiffness(self) -> Self:
        if (self.antiresonance_hz is None) == (self.stiffness_nm_rad is None):
            raise ValueError("either antiresonance_hz or stiffness_nm_rad")
        return self

    def coupling(self, inertia_kg_m2: float) -> Coupling:
        """Of a drive train with that inertia. Error: ValueError for a resonance out of range."""
        motor_kg_m2 = inertia_kg_m2 / (1.0 + self.inertia_ratio)
        load_kg_m2 = inertia_kg_m2 - motor_kg_m2
        stiffness = self.stiffness_nm_rad
        if stiffness is None:
            assert self.antiresonance_hz is not None
            stiffness = load_kg_m2 * (math.tau * self.antiresonance_hz) ** 2
        found = Coupling(
            motor_kg_m2,
            load_kg_m2,
            stiffness,
            self.damping_ratio,
            self.backlash_rad,
            Side(self.encoder),
        )
        if found.resonance_hz > RESONANCE_MAX_HZ:
            raise ValueError(
                f"a resonance of at most {RESONANCE_MAX_HZ:.0f} Hz, this is {found.resonance_hz:.0f} Hz; "
                "without the table the shaft is rigid"
            )
        return found


class FrictionTable(Section):
    """``[friction]``: what goes beyond the constant friction of ``[mechanics]``."""

    breakaway_nm: CoulombFriction | None = Field(
        default=None, description="friction at rest at positive torque, N m"
    )
    stribeck_rpm: float = Field(
        default=10.0,
        ge=1e-6,
        le=1e6,
        description="speed at which half of what a start takes more is gone, r/min",
    )
    backward_nm: CoulombFriction | None = Field(
        default=None, description="Coulomb friction at negative speed, N m; absent: that of [mechanics]"
    )
    side: Literal["motor", "load"] = Field("motor", description="'motor' or 'load': where it acts")

    def friction(self, coulomb_nm: float) -> Friction:
        """Beside that Coulomb friction. Error: ValueError for a start that takes less than the motion."""
        breakaway_nm = coulomb_nm if self.breakaway_nm is None else self.breakaway_nm
        if breakaway_nm < coulomb_nm:
            raise ValueError(f"breakaway_nm of at least mechanics.coulomb_friction_nm, {coulomb_nm:g} N m")
        backward_nm = coulomb_nm if self.backward_nm is None else self.backward_nm
        return Friction(breakaway_nm, self.stribeck_rpm * RAD_S_PER_RPM, backward_nm, Side(self.side))


class CoggingTable(Section):
    """``[[cogging]]``: a harmonic of the torque that the magnets have on the slots."""

    per_turn: int = Field(ge=1, le=1000, description="periods in a turn of the rotor")
    torque_nm: float = Field(ge=0.0, le=1e5, description="amplitude, N m")
    phase_deg: float = Field(default=0.0, ge=-360.0, le=360.0, description="at the angle 0, degrees")

    @property
    def harmonic(self) -> CoggingHarmonic:
        return CoggingHarmonic(self.per_turn, self.torque_nm, math.radians(self.phase_deg))


def mechanism_of(
    coupling: CouplingTable | None,
    friction: FrictionTable | None,
    cogging: list[CoggingTable] | None,
    inertia_kg_m2: float,
    coulomb_nm: float,
) -> Mechanism | None:
    """What the tables say together; None: nothing. Error: ValueError for what cannot be."""
    if coupling is None and friction is None and not cogging:
        return None
    if friction is not None and friction.side == "load" and coupling is None:
        raise ValueError("[friction] side 'load': a table [coupling] expected")
    return Mechanism(
        None if coupling is None else coupling.coupling(inertia_kg_m2),
        None if friction is None else friction.friction(coulomb_nm),
        tuple(one.harmonic for one in cogging or ()),
    )
