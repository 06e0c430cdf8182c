"""Converts a motor's data sheet into dq parameters, each figure in its maker's own convention.

:mod:`servobench.design.sheet_figures` compares the figures, and reports a contradiction with the convention
in which they would agree.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields

from servobench.design.errors import DesignError
from servobench.design.motor import PmsmParameters, Transform
from servobench.design.sheet_figures import Contradiction, SheetFigures

COPPER_C = 235.0
"""R is proportional to this plus the winding's temperature in degrees C: copper, IEC 60034-1."""


@dataclass(eq=False)
class InconsistentSheet(DesignError):
    """A data sheet that contradicts itself as it was entered."""

    found: Sequence[Contradiction]

    def __str__(self) -> str:
        return "\n".join(map(str, self.found))


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSheet:
    """A maker's printed figures. ``flux``: figures by their names in ``CONVENTIONS``, at least one.

    Resistance and inductances belong to one phase of the equivalent star, :func:`of_phase`.
    """

    name: str
    pole_pairs: int
    resistance_ohm: float
    inductance_d_h: float
    inductance_q_h: float
    flux: Mapping[str, float]
    inertia_kg_m2: float
    rated_torque_nm: float
    rated_speed_rad_s: float
    dc_bus_voltage_v: float
    peak_current_a: float | None = None
    """Peak of the sine, A; from ``peak_torque_nm`` if absent."""
    peak_torque_nm: float | None = None
    rated_current_a: float | None = None
    """Peak of the sine, A."""
    friction_nm: float = 0.0
    viscous_friction_nm_s: float = 0.0
    electrical_time_s: float | None = None
    """L/R as printed on the sheet."""
    mechanical_time_s: float | None = None
    """R J/(3/2 (p phi)^2) as printed on the sheet."""

    def motor(self) -> PmsmParameters:
        """Return the motor in dq parameters, amplitude-invariant: currents are peaks of a phase's."""
        torque_constant = 1.5 * self.emf_constant_v_s
        current_max = self.peak_current_a
        if current_max is None:
            current_max = (self.peak_torque_nm or 0.0) / torque_constant
        return PmsmParameters(
            name=self.name,
            resistance_ohm=self.resistance_ohm,
            inductance_d_h=self.inductance_d_h,
            inductance_q_h=self.inductance_q_h,
            flux_linkage_wb=self.emf_constant_v_s / self.pole_pairs,
            pole_pairs=self.pole_pairs,
            inertia_kg_m2=self.inertia_kg_m2,
            viscous_friction_nm_s=self.viscous_friction_nm_s,
            coulomb_friction_nm=self.friction_nm,
            transform=Transform.AMPLITUDE_INVARIANT,
            rated_torque_nm=self.rated_torque_nm,
            rated_speed_rad_s=self.rated_speed_rad_s,
            current_max_a=current_max,
            dc_bus_voltage_v=self.dc_bus_voltage_v,
        )

    @property
    def figures(self) -> SheetFigures:
        """The same figures, ready for comparison."""
        return SheetFigures(**{each.name: getattr(self, each.name) for each in fields(SheetFigures)})

    @property
    def made_flux(self) -> str:
        """The figure from which the flux is taken."""
        return self.figures.made_flux

    @property
    def emf_constant_v_s(self) -> float:
        """p phi: peak of a phase's back-EMF per mechanical rad/s, V s."""
        constant = self.figures.emf_constant_v_s
        assert constant is not None, "a sheet has at least one figure of the flux"
        return constant

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield figures of the sheet that cannot all be true, if entered in the right conventions."""
        return self.figures.contradictions()


def of_phase(value: float, *, between_terminals: bool, delta: bool) -> float:
    """Return the resistance or inductance of one phase of the equivalent star, in the unit of ``value``.

    Between two terminals of a star lie two phases; a delta's phase is three times that of its star.
    """
    if between_terminals:
        return value / 2.0
    return value / 3.0 if delta else value


def at_temperature(resistance: float, given_c: float, wanted_c: float) -> float:
    """Return a copper winding's resistance at ``wanted_c`` from that at ``given_c``, IEC 60034-1."""
    return resistance * (COPPER_C + wanted_c) / (COPPER_C + given_c)
