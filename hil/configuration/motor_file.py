"""Motor files: the parameters of a PMSM in TOML, turned into
:class:`servobench.design.motor.PmsmParameters`."""

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationInfo, field_validator

from servobench.design.mechanism import Mechanism
from servobench.design.motor import PmsmParameters, Transform
from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.vendors.motor_objects import POLE_PAIRS_MAX
from servobench.hil.configuration.config_files import Section, load_file
from servobench.hil.configuration.mechanism_tables import (
    CoggingTable,
    CouplingTable,
    FrictionTable,
    mechanism_of,
)
from servobench.hil.configuration.quantities import (
    CoulombFriction,
    Current,
    FluxLinkage,
    Inductance,
    Inertia,
    Resistance,
    Speed,
    Torque,
    ViscousFriction,
    Voltage,
)


class Windings(Section):
    """``[motor]``: the electric part, in the dq frame of ``transform``."""

    name: str = Field(min_length=1, description="the motor's name in quotes")
    resistance_ohm: Resistance = Field(description="resistance of a phase, ohm")
    inductance_d_h: Inductance = Field(description="d-axis inductance, H")
    inductance_q_h: Inductance = Field(description="q-axis inductance, H")
    flux_linkage_wb: FluxLinkage = Field(description="permanent-magnet flux of the dq equations, Wb")
    pole_pairs: int = Field(gt=0, le=POLE_PAIRS_MAX, description="number of pole pairs")
    transform: Literal["power_invariant", "amplitude_invariant"] = Field(
        description="'power_invariant' or 'amplitude_invariant'"
    )


class MotorMechanics(Section):
    """``[mechanics]``: the rotor and everything that turns with it."""

    inertia_kg_m2: Inertia = Field(description="moment of inertia, kg m^2")
    viscous_friction_nm_s: ViscousFriction = 0.0
    """N m per rad/s."""
    coulomb_friction_nm: CoulombFriction = 0.0


class Rating(Section):
    """``[rating]``: the ratings of the motor and its inverter."""

    torque_nm: Torque = Field(description="continuous torque, N m")
    speed_rpm: Speed = Field(description="rated speed, r/min")
    current_max_a: Current = Field(description="largest dq current, A")
    dc_bus_voltage_v: Voltage = Field(description="voltage of the inverter's DC bus, V")


class MotorFile(Section):
    """A whole motor file."""

    motor: Windings = Field(description="the table [motor]")
    mechanics: MotorMechanics = Field(description="the table [mechanics]")
    rating: Rating = Field(description="the table [rating]")
    coupling: CouplingTable | None = Field(default=None, description="the table [coupling]")
    friction: FrictionTable | None = Field(default=None, description="the table [friction]")
    cogging: list[CoggingTable] | None = Field(default=None, description="the tables [[cogging]]")

    @field_validator("coupling")
    @classmethod
    def _can_be_stepped(cls, coupling: CouplingTable | None, found: ValidationInfo) -> CouplingTable | None:
        if coupling is not None and "mechanics" in found.data:
            coupling.coupling(found.data["mechanics"].inertia_kg_m2)
        return coupling

    @field_validator("friction")
    @classmethod
    def _goes_with_the_rest(
        cls, friction: FrictionTable | None, found: ValidationInfo
    ) -> FrictionTable | None:
        if friction is not None and "mechanics" in found.data:
            friction.friction(found.data["mechanics"].coulomb_friction_nm)
        if friction is not None and friction.side == "load" and found.data.get("coupling") is None:
            raise ValueError("side 'motor', or a table [coupling]")
        return friction

    def _mechanism(self) -> Mechanism | None:
        mechanics = self.mechanics
        return mechanism_of(
            self.coupling, self.friction, self.cogging, mechanics.inertia_kg_m2, mechanics.coulomb_friction_nm
        )

    @property
    def tables(self) -> dict[str, Any]:
        """What is to be written into a file."""
        return self.model_dump(mode="json", exclude_none=True)

    @property
    def parameters(self) -> PmsmParameters:
        """The same in the form for plant and firmware."""
        return PmsmParameters(
            **self.motor.model_dump(exclude={"transform"}),
            **self.mechanics.model_dump(),
            transform=Transform(self.motor.transform),
            rated_torque_nm=self.rating.torque_nm,
            rated_speed_rad_s=self.rating.speed_rpm * RAD_S_PER_RPM,
            current_max_a=self.rating.current_max_a,
            dc_bus_voltage_v=self.rating.dc_bus_voltage_v,
            mechanism=self._mechanism(),
        )


LING2012 = MotorFile(
    motor=Windings(
        name="Ling2012",
        resistance_ohm=2.875,
        inductance_d_h=0.0085,
        inductance_q_h=0.0085,
        flux_linkage_wb=0.0999392,
        pole_pairs=4,
        transform="power_invariant",
    ),
    mechanics=MotorMechanics(inertia_kg_m2=0.0008, viscous_friction_nm_s=0.00185),
    rating=Rating(torque_nm=2.0, speed_rpm=1500.0, current_max_a=15.0, dc_bus_voltage_v=300.0),
)
"""[Ling2012] Table 1: the default motor of ``hil simulate``. Current and DC bus were chosen here."""


def load_motor(path: Path, named_by: NamedBy | None = None) -> MotorFile:
    """Load the motor file at ``path``; ``named_by``: its source. Raises BadInput or BadInputs."""
    return load_file(MotorFile, path, "motor file", named_by)


def speed_max_rpm(motor: PmsmParameters) -> float:
    """Return the speed at which the back-EMF alone takes the whole voltage of the inverter, r/min."""
    return motor.voltage_max_v / (motor.pole_pairs * motor.flux_linkage_wb) / RAD_S_PER_RPM
