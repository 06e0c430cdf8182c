"""Converts a motor's data sheet into dq parameters, each figure in its maker's own convention.

:mod:`servobench.design.sheet_figures` compares the figures, and reports a contradiction with the convention
in which they would agree.

Usual mistakes in units and conventions of a motor's figures, and the one that would make them agree.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations
from typing import Any, Final, NamedTuple

from servobench.design.errors import DesignError
from servobench.design.motor import CONVENTIONS, PmsmParameters, Transform, kind_of
from servobench.design.sheet_figures import FIELDS, Contradiction, SheetFigures

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


class Misreading(NamedTuple):
    """A figure entered in another unit or convention."""

    fields: tuple[str, ...]
    factor: float
    """Factor from the entered to the true value."""
    text: str


_TORQUE, _CURRENT = ("rated_torque_nm",), ("rated_current_a",)
_INDUCTANCE = ("inductance_d_h", "inductance_q_h")
SLIPS: Final = (
    Misreading(_TORQUE, 1e-3, "N mm taken for N m"),
    Misreading(_TORQUE, 1e-2, "N cm taken for N m"),
    Misreading(_CURRENT, 1e-3, "mA taken for A"),
    Misreading(_CURRENT, math.sqrt(0.5), "peak taken for rms"),
    Misreading(_CURRENT, math.sqrt(2.0), "rms taken for peak"),
    Misreading(("rated_speed_rad_s",), 30.0 / math.pi, "rad/s taken for r/min"),
    Misreading(("rated_speed_rad_s",), math.pi / 30.0, "r/min taken for rad/s"),
    Misreading(("dc_bus_voltage_v",), math.sqrt(2.0), "AC between lines taken for the DC bus"),
    Misreading(("dc_bus_voltage_v",), math.sqrt(6.0), "AC of a phase taken for the DC bus"),
    Misreading(("resistance_ohm",), 0.5, "between lines taken for a phase"),
    Misreading(("resistance_ohm",), 1e-3, "mohm taken for ohm"),
    Misreading(_INDUCTANCE, 0.5, "between lines taken for a phase"),
    Misreading(_INDUCTANCE, 1e-3, "mH taken for H"),
    Misreading(_INDUCTANCE, 1e3, "H taken for mH"),
    Misreading(_INDUCTANCE, 1e-6, "uH taken for H"),
    Misreading(("pole_pairs",), 0.5, "poles taken for pole pairs"),
    Misreading(("inertia_kg_m2",), 1e-4, "kg cm^2 taken for kg m^2"),
    Misreading(("inertia_kg_m2",), 1e-6, "kg mm^2 taken for kg m^2"),
    Misreading(("inertia_kg_m2",), 1e-7, "g cm^2 taken for kg m^2"),
    Misreading(_CURRENT, math.sqrt(3.0), "the phase of a delta taken for the line"),
    Misreading(_CURRENT, math.sqrt(1.0 / 3.0), "the line of a delta taken for the phase"),
    Misreading(_TORQUE, 0.1129848, "lb in taken for N m"),
    Misreading(_TORQUE, 0.007061552, "oz in taken for N m"),
    Misreading(_TORQUE, 0.0980665, "kgf cm taken for N m"),
    *(
        Misreading((name,), factor, "a decimal point at the wrong place")
        for name in FIELDS
        if name != "pole_pairs"
        for factor in (0.1, 10.0)
    ),
)
"""The usual mistakes, each with its factor; the most frequent first."""
SWAPS: Final = (
    *combinations(("rated_torque_nm", "rated_current_a", "rated_speed_rad_s", "dc_bus_voltage_v"), 2),
    ("resistance_ohm", "inductance_q_h"),
    ("rated_current_a", "peak_current_a"),
)
"""Figures entered in each other's place."""


def readings(figures: SheetFigures) -> list[str]:
    """Return each single mistake that explains all figures, the most frequent first."""
    return [text for text, others in _other_readings(figures) if others.is_plausible()]


def _other_readings(figures: SheetFigures) -> Iterator[tuple[str, SheetFigures]]:
    for slip in SLIPS:
        values = {name: getattr(figures, name) for name in slip.fields}
        if None in values.values():
            continue
        changed: dict[str, Any] = {name: slip.factor * value for name, value in values.items()}
        title = FIELDS[slip.fields[0]]
        name = title.text.split()[0] if len(changed) > 1 else title.text
        now = title.shown(changed[slip.fields[0]])
        yield f"{name} {now} ({slip.text})", replace(figures, **changed)
    for name, value in figures.flux.items():
        for other in CONVENTIONS:
            if other not in figures.flux and kind_of(other) == kind_of(name):
                rest = {key: each for key, each in figures.flux.items() if key != name}
                yield (
                    f"{other} = {value:g} ({name} was entered)",
                    replace(figures, flux={**rest, other: value}),
                )
    for one, two in SWAPS:
        first, second = getattr(figures, one), getattr(figures, two)
        if first is not None and second is not None:
            ratio = FIELDS[one].scale / FIELDS[two].scale
            swapped: dict[str, Any] = {one: second / ratio, two: first * ratio}
            text = f"{FIELDS[one].text} and {FIELDS[two].text} in each other's place"
            yield text, replace(figures, **swapped)
