"""A motor's data sheet turned into dq parameters, each figure in its maker's own convention.

A sheet gives p phi (pole pairs times flux linkage, the peak of a phase's back-EMF per mechanical rad/s) in
one of nine ways, which differ by sqrt(2), sqrt(3), 3/2 and pi/3 and are seldom told apart. For a sinusoidal
back-EMF:

    torque per line current, rms      Kt = 3/sqrt(2) p phi        three phases, current in phase with EMF
    torque per line current, peak     Kt = 3/2 p phi
    torque per DC current, six-step   Kt = 3 sqrt(3)/pi p phi     two phases at a time, mean over 60 degrees
    back-EMF between terminals, rms   Ke = sqrt(3/2) p phi        sqrt(3) times the phase's

Every two figures of one sheet are held against each other, and a contradiction is told with the convention in
which they would agree.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

from design.errors import DesignError
from design.motor import RAD_S_PER_KRPM, PmsmParameters, Transform

COPPER_C = 235.0
"""R is proportional to this plus the winding's temperature in degrees C: copper, IEC 60034-1."""
AGREEING = 0.12
"""Share by which two figures of one sheet may differ. Makers allow their figures 10 %, and give torque per
ampere for a warm motor and back-EMF for a cold one; most wrong conventions are 28 % apart or more."""
AGREEING_WELL = 0.05
"""Within which a ratio of two time constants is taken for a convention's: two figures' rounding."""
LOSSES = 0.25
"""Share of the torque that friction, iron and saturation may take at the rated point."""
SATURATION = 0.5
"""The same towards the peak."""

_SIX_STEP = 3.0 * math.sqrt(3.0) / math.pi
"""Mean of three phases' rectified voltage, over the peak of one."""

FLUX_FACTORS: Mapping[str, float] = {
    "kt_nm_arms": 3.0 / math.sqrt(2.0),
    "kt_nm_apk": 1.5,
    "kt_nm_adc": _SIX_STEP,
    "ke_line_vrms_krpm": math.sqrt(1.5) * RAD_S_PER_KRPM,
    "ke_line_vpk_krpm": math.sqrt(3.0) * RAD_S_PER_KRPM,
    "ke_phase_vrms_krpm": math.sqrt(0.5) * RAD_S_PER_KRPM,
    "ke_phase_vpk_krpm": RAD_S_PER_KRPM,
}
"""What a sheet may give for p phi -> that figure per p phi in V s. The first that is given makes the flux."""
SPEED_FACTORS: Mapping[str, float] = {
    "kv_rpm_vdc": _SIX_STEP * math.pi / 30.0,
    "kv_rpm_vpk": math.sqrt(3.0) * math.pi / 30.0,
}
"""The same for figures that are inverse to p phi: r/min per volt of a six-step drive's DC, and of the peak
between terminals."""
CONVENTIONS = (*FLUX_FACTORS, *SPEED_FACTORS)


@dataclass(frozen=True, slots=True)
class Contradiction:
    """Two figures of a sheet that cannot both be meant as they were entered."""

    figures: str
    """Which ones, with their values."""
    difference: str
    """What follows from one for the other, with units."""
    explanation: str = ""
    """The convention in which they agree, if there is one."""

    def __str__(self) -> str:
        return "; ".join(part for part in (f"{self.figures}: {self.difference}", self.explanation) if part)


@dataclass(eq=False)
class InconsistentSheet(DesignError):
    """A data sheet that contradicts itself as it was entered."""

    found: Sequence[Contradiction]

    def __str__(self) -> str:
        return "\n".join(map(str, self.found))


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSheet:
    """What a maker prints. ``flux``: figures by their names in ``CONVENTIONS``, at least one.

    Resistance and inductances are of one phase of the star that stands for the winding, :func:`of_phase`.
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
    """L/R as the sheet gives it."""
    mechanical_time_s: float | None = None
    """R J/(3/2 (p phi)^2) as the sheet gives it."""

    def motor(self) -> PmsmParameters:
        """The motor in dq parameters, amplitude-invariant: currents are peaks of a phase's."""
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
    def made_flux(self) -> str:
        """Which figure the flux is taken from."""
        return next(name for name in CONVENTIONS if name in self.flux)

    @property
    def emf_constant_v_s(self) -> float:
        """p phi: peak of a phase's back-EMF per mechanical rad/s, V s."""
        return emf_constant(self.made_flux, self.flux[self.made_flux])

    def contradictions(self) -> Iterator[Contradiction]:
        """What on the sheet cannot be true at once, if entered in the right conventions."""
        for first, second in combinations((name for name in CONVENTIONS if name in self.flux), 2):
            yield from self._of_flux(first, second)
        if self.rated_current_a is not None:
            yield from self._of_current("rated", self.rated_current_a, self.rated_torque_nm, LOSSES)
        if self.peak_current_a is not None and self.peak_torque_nm is not None:
            yield from self._of_current("peak", self.peak_current_a, self.peak_torque_nm, SATURATION)
        yield from self._of_voltage()
        yield from self._of_times()

    def _of_flux(self, first: str, second: str) -> Iterator[Contradiction]:
        one, other = (emf_constant(name, self.flux[name]) for name in (first, second))
        if _agree(one, other, AGREEING):
            return
        follows = figure(second, one)
        yield Contradiction(
            f"{first} = {self.flux[first]:g} and {second} = {self.flux[second]:g}",
            f"from the first follows {second} = {follows:.4g}",
            _explained(first, self.flux[first], second, self.flux[second]),
        )

    def _of_current(
        self, point: str, current_a: float, torque_nm: float, lost: float
    ) -> Iterator[Contradiction]:
        """``lost``: share of the torque that need not reach the shaft."""
        airgap_nm = 1.5 * self.emf_constant_v_s * current_a

        def agree(factor: float) -> bool:
            return 1.0 - AGREEING <= factor * airgap_nm / torque_nm <= 1.0 / (1.0 - lost)

        if agree(1.0):
            return
        readings = {
            math.sqrt(0.5): "it fits if the current is a peak value and was entered as rms",
            math.sqrt(2.0): "it fits if the current is an rms value and was entered as a peak",
        }
        yield Contradiction(
            f"{point} torque {torque_nm:g} N m and {point} current {current_a / math.sqrt(2.0):.4g} A rms",
            f"with {self.made_flux} this current makes {airgap_nm:.4g} N m",
            "".join(text for factor, text in readings.items() if agree(factor)),
        )

    def _of_voltage(self) -> Iterator[Contradiction]:
        emf = self.emf_constant_v_s * self.rated_speed_rad_s
        most = self.dc_bus_voltage_v / math.sqrt(3.0)
        if emf > most:
            yield Contradiction(
                f"rated speed {self.rated_speed_rad_s * 30.0 / math.pi:.5g} r/min and "
                f"DC bus {self.dc_bus_voltage_v:g} V",
                f"the back-EMF alone has {emf:.4g} V of a phase there, the inverter {most:.4g} V",
            )

    def _of_times(self) -> Iterator[Contradiction]:
        electrical = 0.5 * (self.inductance_d_h + self.inductance_q_h) / self.resistance_ohm
        if self.electrical_time_s is not None and not _agree(electrical, self.electrical_time_s, AGREEING):
            ratio = self.electrical_time_s / electrical
            yield Contradiction(
                f"electrical time constant {1e3 * self.electrical_time_s:g} ms",
                f"inductance over resistance is {1e3 * electrical:.4g} ms",
                "one of the two is of a phase, the other between terminals"
                if _agree(ratio, 2.0, AGREEING_WELL) or _agree(ratio, 0.5, AGREEING_WELL) else "",
            )  # fmt: skip
        mechanical = self.resistance_ohm * self.inertia_kg_m2 / (1.5 * self.emf_constant_v_s**2)
        given = self.mechanical_time_s
        if given is not None and not _agree(mechanical, given, 2.0 * AGREEING):  # the flux enters squared
            yield Contradiction(
                f"mechanical time constant {1e3 * given:g} ms",
                f"R J/(3/2 (p phi)^2) is {1e3 * mechanical:.4g} ms",
                _time_explained(given / mechanical),
            )


def of_phase(value: float, *, between_terminals: bool, delta: bool) -> float:
    """Resistance or inductance of a phase of the star that stands for the winding, in the unit of ``value``.

    Between two terminals of a star lie two phases; a delta's phase is three times that of its star.
    """
    if between_terminals:
        return value / 2.0
    return value / 3.0 if delta else value


def at_temperature(resistance: float, given_c: float, wanted_c: float) -> float:
    """A copper winding's resistance at ``wanted_c`` from that at ``given_c``, IEC 60034-1."""
    return resistance * (COPPER_C + wanted_c) / (COPPER_C + given_c)


def emf_constant(name: str, value: float) -> float:
    """p phi in V s from one figure; ``name``: one of ``CONVENTIONS``."""
    if name in SPEED_FACTORS:
        return 1.0 / (SPEED_FACTORS[name] * value)
    return value / FLUX_FACTORS[name]


def figure(name: str, emf_constant_v_s: float) -> float:
    """The inverse of :func:`emf_constant`."""
    if name in SPEED_FACTORS:
        return 1.0 / (SPEED_FACTORS[name] * emf_constant_v_s)
    return emf_constant_v_s * FLUX_FACTORS[name]


def _agree(one: float, other: float, within: float) -> bool:
    return abs(math.log(one / other)) <= math.log1p(within)


def _kind(name: str) -> str:
    """kt, ke or kv."""
    return name[:2]


def _explained(first: str, one: float, second: str, other: float) -> str:
    """Which readings of one of the two make them agree, best first; each keeps its kind."""
    sides = ((first, one, emf_constant(second, other)), (second, other, emf_constant(first, one)))
    readings = sorted(
        (abs(math.log(emf_constant(reading, value) / fixed)), f"{reading} = {value:g}")
        for name, value, fixed in sides
        for reading in CONVENTIONS
        if reading != name and _kind(reading) == _kind(name)
        if _agree(emf_constant(reading, value), fixed, AGREEING)
    )
    return f"they agree if {' or '.join(text for _, text in readings)} is meant" if readings else ""


def _time_explained(ratio: float) -> str:
    """``ratio``: the time constant on the sheet over the one that follows."""
    reasons = {2.0: "as if the resistance were entered between terminals and is of a phase",
               0.5: "as if the resistance were entered of a phase and is between terminals"}  # fmt: skip
    near = [text for factor, text in reasons.items() if _agree(ratio, factor, AGREEING)]
    return near[0] if near else ""
