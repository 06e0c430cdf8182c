"""Motor files: the parameters of a PMSM in TOML, turned into
:class:`servobench.design.motor.PmsmParameters`, and the mechanism between rotor and load: ``[coupling]``,
``[friction]``, ``[[cogging]]``, ``[cogging_by_angle]``, ``[load]`` and ``[switches]``; ``[saturation]``,
``[temperature]`` and ``[commutation]`` are in :mod:`servobench.hil.configuration.motor_tables`, and
``[twin]``, in :mod:`servobench.hil.configuration.twin_table`, says what all of it rests on.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from servobench.design.mechanism import CoggingHarmonic, Coupling, Friction, Mechanism, Side
from servobench.design.motor import PmsmParameters, Transform
from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.vendors.motor_objects import POLE_PAIRS_MAX
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.motor_tables import (
    CommutationTable,
    LoadTables,
    SaturationTable,
    SwitchesTable,
    TemperatureTable,
)
from servobench.hil.configuration.preset_files import FromPreset, load_file_or_preset
from servobench.hil.configuration.quantities import (
    CoulombFriction,
    Current,
    FluxLinkage,
    Inductance,
    Inertia,
    Resistance,
    SignedTorque,
    Speed,
    Stiffness,
    Torque,
    ViscousFriction,
    Voltage,
)
from servobench.hil.configuration.twin_table import TwinTable

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
    second_encoder: bool = False
    """The other side has one too: the drive tells it in 60E4h:1, and controls by the first."""

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
            self.second_encoder,
        )
        if found.resonance_hz > RESONANCE_MAX_HZ:
            raise ValueError(
                f"{_too_fast('a resonance', found.resonance_hz)}; without the table the shaft is rigid"
            )
        return found


def _too_fast(what: str, found_hz: float) -> str:
    return f"{what} of at most {RESONANCE_MAX_HZ:.0f} Hz, this is {found_hz:.0f} Hz"


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
    load_percent: float = Field(
        default=0.0, ge=0.0, le=100.0, description="of the load torque, what it adds to Coulomb friction"
    )
    bristle_nm_rad: Stiffness | None = Field(
        default=None, description="stiffness of bristles that bend before they slip (LuGre), N m/rad"
    )
    bristle_damping_ratio: float = Field(
        default=1.0, ge=0.0, le=2.0, description="of the mass that rubs, on its bristles"
    )

    def friction(self, coulomb_nm: float) -> Friction:
        """Beside that Coulomb friction. Error: ValueError for a start that takes less than the motion."""
        breakaway_nm = coulomb_nm if self.breakaway_nm is None else self.breakaway_nm
        if breakaway_nm < coulomb_nm:
            raise ValueError(f"breakaway_nm of at least mechanics.coulomb_friction_nm, {coulomb_nm:g} N m")
        backward_nm = coulomb_nm if self.backward_nm is None else self.backward_nm
        if self.bristle_nm_rad and breakaway_nm - coulomb_nm + min(coulomb_nm, backward_nm) <= 0.0:
            raise ValueError("bristle_nm_rad with friction either way: breakaway_nm above 0")
        return Friction(
            breakaway_nm,
            self.stribeck_rpm * RAD_S_PER_RPM,
            backward_nm,
            Side(self.side),
            0.01 * self.load_percent,
            self.bristle_nm_rad or 0.0,
            self.bristle_damping_ratio,
        )


class CoggingTable(Section):
    """``[[cogging]]``: a harmonic of the torque that the magnets have on the slots."""

    per_turn: int = Field(ge=1, le=1000, description="periods in a turn of the rotor")
    torque_nm: float = Field(ge=0.0, le=1e5, description="amplitude, N m")
    phase_deg: float = Field(default=0.0, ge=-360.0, le=360.0, description="at the angle 0, degrees")

    @property
    def harmonic(self) -> CoggingHarmonic:
        return CoggingHarmonic(self.per_turn, self.torque_nm, math.radians(self.phase_deg))


class CoggingPointsTable(Section):
    """``[cogging_by_angle]``: the same as a table, instead of harmonics."""

    torque_nm: Annotated[tuple[SignedTorque, ...], Field(strict=False, min_length=2, max_length=4096)]
    """At angles that divide a period evenly, from 0 on, straight between them, N m."""
    per_turn: int = Field(default=1, ge=1, le=1000, description="periods in a turn of the rotor")

    @property
    def points_nm(self) -> tuple[float, ...]:
        """Over a whole turn."""
        return self.per_turn * self.torque_nm


def mechanism_of(
    coupling: CouplingTable | None,
    friction: FrictionTable | None,
    cogging: list[CoggingTable] | CoggingPointsTable | None,
    load: LoadTables | None,
    switches: SwitchesTable | None,
    inertia_kg_m2: float,
    coulomb_nm: float,
) -> Mechanism | None:
    """What the tables say together; None: nothing. Error: ValueError for what cannot be."""
    if coupling is None and friction is None and not cogging and load is None and switches is None:
        return None
    if friction is not None and friction.side == "load" and coupling is None:
        raise ValueError("[friction] side 'load': a table [coupling] expected")
    return Mechanism(
        None if coupling is None else coupling.coupling(inertia_kg_m2),
        None if friction is None else friction.friction(coulomb_nm),
        () if isinstance(cogging, CoggingPointsTable) else tuple(one.harmonic for one in cogging or ()),
        None if load is None else load.load,
        None if switches is None else switches.switches,
        cogging.points_nm if isinstance(cogging, CoggingPointsTable) else (),
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


class MotorFile(FromPreset):
    """A whole motor file."""

    KIND: ClassVar[str] = "motors"

    motor: Windings = Field(description="the table [motor]")
    mechanics: MotorMechanics = Field(description="the table [mechanics]")
    rating: Rating = Field(description="the table [rating]")
    coupling: CouplingTable | None = Field(default=None, description="the table [coupling]")
    friction: FrictionTable | None = Field(default=None, description="the table [friction]")
    cogging: list[CoggingTable] | None = Field(default=None, description="the tables [[cogging]]")
    cogging_by_angle: CoggingPointsTable | None = Field(
        default=None, description="the table [cogging_by_angle], instead of [[cogging]]"
    )
    load: LoadTables | None = Field(default=None, description="the table [load]")
    switches: SwitchesTable | None = Field(default=None, description="the table [switches]")
    saturation: SaturationTable | None = Field(default=None, description="the table [saturation]")
    temperature: TemperatureTable | None = Field(default=None, description="the table [temperature]")
    commutation: CommutationTable | None = Field(default=None, description="the table [commutation]")
    twin: TwinTable | None = Field(default=None, description="the table [twin]")

    @field_validator("saturation")
    @classmethod
    def _is_iron(cls, saturation: SaturationTable | None, found: ValidationInfo) -> SaturationTable | None:
        if saturation is not None and {"motor", "mechanics", "rating"} <= set(found.data):
            saturation.iron(cls.model_construct(**found.data)._ideal())
        return saturation

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
            mechanics, coupling = found.data["mechanics"], found.data.get("coupling")
            rubs = friction.friction(mechanics.coulomb_friction_nm)
            shaft = None if coupling is None else coupling.coupling(mechanics.inertia_kg_m2)
            fastest_hz = Mechanism(shaft, rubs).fastest_hz(mechanics.inertia_kg_m2)
            if fastest_hz > RESONANCE_MAX_HZ:
                raise ValueError(_too_fast("bristle_nm_rad with a frequency on the bristles", fastest_hz))
        if friction is not None and friction.side == "load" and found.data.get("coupling") is None:
            raise ValueError("side 'motor', or a table [coupling]")
        return friction

    @field_validator("cogging_by_angle")
    @classmethod
    def _one_cogging(
        cls, cogging: CoggingPointsTable | None, found: ValidationInfo
    ) -> CoggingPointsTable | None:
        if cogging is not None and found.data.get("cogging"):
            raise ValueError("either [[cogging]] or [cogging_by_angle]")
        return cogging

    @field_validator("load")
    @classmethod
    def _stops_can_be_stepped(cls, load: LoadTables | None, found: ValidationInfo) -> LoadTables | None:
        if load is None or load.end_stops is None or "mechanics" not in found.data:
            return load
        inertia_kg_m2, coupling = found.data["mechanics"].inertia_kg_m2, found.data.get("coupling")
        shaft = None if coupling is None else coupling.coupling(inertia_kg_m2)
        friction = found.data.get("friction")
        rubs = None if friction is None else friction.friction(found.data["mechanics"].coulomb_friction_nm)
        fastest_hz = Mechanism(shaft, rubs, load=load.load).fastest_hz(inertia_kg_m2)
        if fastest_hz > RESONANCE_MAX_HZ:
            raise ValueError(_too_fast("end_stops.stiffness_nm_rad with a frequency on the stop", fastest_hz))
        return load

    def _ideal(self) -> PmsmParameters:
        """The machine of these windings on a rigid shaft, with iron that never saturates."""
        return PmsmParameters(
            **self.motor.model_dump(exclude={"transform"}),
            **self.mechanics.model_dump(),
            transform=Transform(self.motor.transform),
            rated_torque_nm=self.rating.torque_nm,
            rated_speed_rad_s=self.rating.speed_rpm * RAD_S_PER_RPM,
            current_max_a=self.rating.current_max_a,
            dc_bus_voltage_v=self.rating.dc_bus_voltage_v,
        )

    def _mechanism(self) -> Mechanism | None:
        mechanics = self.mechanics
        return mechanism_of(
            self.coupling,
            self.friction,
            self.cogging or self.cogging_by_angle,
            self.load,
            self.switches,
            mechanics.inertia_kg_m2,
            mechanics.coulomb_friction_nm,
        )

    @property
    def tables(self) -> dict[str, Any]:
        """Tables as they are written into a file."""
        return self.model_dump(mode="json", exclude_none=True, exclude={"preset"})

    @property
    def parameters(self) -> PmsmParameters:
        """The same in the form for plant and firmware."""
        ideal = self._ideal()
        return replace(
            ideal,
            mechanism=self._mechanism(),
            iron=None if self.saturation is None else self.saturation.iron(ideal),
            heat=None if self.temperature is None else self.temperature.heat,
            commutation=None if self.commutation is None else self.commutation.commutation,
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
    """Load the motor file at ``path``, or a preset; ``named_by``: its source.

    Raises BadInput or BadInputs.
    """
    return load_file_or_preset(MotorFile, path, "motor file", named_by)
