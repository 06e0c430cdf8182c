"""Checks that the figures of a motor's data sheet or nameplate can all be true at once.

Figures given twice are compared with each other, the others with their common limits: the power at the rated
point is no more than the inverter can give (sqrt(3) U I, at a power factor and an efficiency of one), and
times, voltages and frequencies lie in bands in which every motor does.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final, NamedTuple

from servobench.design.motor import (
    AGREEING,
    CONVENTIONS,
    agree_within,
    emf_constant,
    explained,
    figure,
)

AGREEING_WELL = 0.05
"""Ratio of two time constants that still counts as a convention's: two figures' rounding."""
LOSSES = 0.25
"""Share of the torque that friction, iron and saturation may take at the rated point."""
SATURATION = 0.5
"""The same towards the peak."""
POWER_MAX: Final = 1.005
"""Shaft power over volts times amperes at a power factor and an efficiency of one: no motor exceeds one;
three digits are printed. Stall torque and no-load speed of one sheet reach up to 0.98."""
POWER_USUAL: Final = (0.12, 0.95)
"""The same with the copper's loss, for published motors at their own DC bus: 0.26 to 0.8. Less occurs where a
motor runs from the wrong bus, and where revolutions were taken for radians."""
HIGH_FREQUENCY_HZ: Final = 2000.0


@dataclass(frozen=True, slots=True)
class Contradiction:
    """Figures that cannot all be correct as entered."""

    figures: str
    """The figures involved, with their values."""
    difference: str
    """The value that follows from the others, with units."""
    explanation: str = ""
    """The convention in which they agree, if there is one."""
    fields: tuple[str, ...] = ()
    """Their names in :class:`SheetFigures`."""

    def __str__(self) -> str:
        return "; ".join(part for part in (f"{self.figures}: {self.difference}", self.explanation) if part)


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetFigures:
    """The figures given for a motor; None where none is.

    Resistance and inductances belong to one phase of the equivalent star, currents are peaks.
    """

    rated_torque_nm: float | None = None
    rated_speed_rad_s: float | None = None
    rated_current_a: float | None = None
    dc_bus_voltage_v: float | None = None
    peak_torque_nm: float | None = None
    peak_current_a: float | None = None
    pole_pairs: float | None = None
    resistance_ohm: float | None = None
    inductance_d_h: float | None = None
    inductance_q_h: float | None = None
    flux: Mapping[str, float] = field(default_factory=dict)
    """Flux figures by their names in ``CONVENTIONS``."""
    inertia_kg_m2: float | None = None
    """Inertia of the rotor."""
    electrical_time_s: float | None = None
    """L/R as printed on the sheet."""
    mechanical_time_s: float | None = None
    """R J/(3/2 (p phi)^2) as printed on the sheet."""

    @property
    def made_flux(self) -> str:
        """The figure from which the flux is taken; empty if none is given."""
        return next((name for name in CONVENTIONS if name in self.flux), "")

    @property
    def emf_constant_v_s(self) -> float | None:
        """p phi: peak of a phase's back-EMF per mechanical rad/s, V s; None if no figure gives it."""
        name = self.made_flux
        return emf_constant(name, self.flux[name]) if name else None

    @property
    def frequency_hz(self) -> float | None:
        """Frequency in the winding at the rated speed."""
        return _ratio([self.pole_pairs, self.rated_speed_rad_s], [math.tau])

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield figures that cannot all be true, if entered in the right conventions and units."""
        for first, second in combinations((name for name in CONVENTIONS if name in self.flux), 2):
            yield from self._of_flux(first, second)
        yield from self._of_current("rated", self.rated_current_a, self.rated_torque_nm, LOSSES)
        yield from self._of_current("peak", self.peak_current_a, self.peak_torque_nm, SATURATION)
        yield from self._of_power()
        yield from self._of_voltage()
        yield from self._of_bands()
        yield from self._of_times()

    def doubts(self) -> Iterator[Contradiction]:
        """Yield figures that are possible, but seldom intended."""
        share = self._power_share()
        used = None if share is None else share + (_drop(self) or 0.0)
        if used is not None and not POWER_USUAL[0] <= used <= POWER_USUAL[1]:
            yield Contradiction(
                self._named(*_RATED_POINT),
                f"the rated point needs {100.0 * used:.3g} % of what volts and amperes make, that of most "
                "motors a quarter to eight tenths",
                fields=_RATED_POINT,
            )
        hertz = self.frequency_hz
        if hertz is not None and hertz > HIGH_FREQUENCY_HZ:
            yield Contradiction(
                self._named("pole_pairs", "rated_speed_rad_s"),
                f"the rated speed has {hertz:.0f} Hz in the winding, servo motors 50 to 600 Hz",
                fields=("pole_pairs", "rated_speed_rad_s"),
            )

    def is_plausible(self) -> bool:
        """Return True without contradictions and doubts."""
        return next(self.contradictions(), None) is None and next(self.doubts(), None) is None

    def _of_flux(self, first: str, second: str) -> Iterator[Contradiction]:
        one, other = (emf_constant(name, self.flux[name]) for name in (first, second))
        if agree_within(one, other, AGREEING):
            return
        follows = figure(second, one)
        yield Contradiction(
            f"{first} = {self.flux[first]:g} and {second} = {self.flux[second]:g}",
            f"from the first follows {second} = {follows:.4g}",
            explained(first, self.flux[first], second, self.flux[second]),
            ("flux",),
        )

    def _of_current(
        self, point: str, current_a: float | None, torque_nm: float | None, lost: float
    ) -> Iterator[Contradiction]:
        """Compare current and torque at one point. ``lost``: share of the torque that need not reach the
        shaft."""
        constant = self.emf_constant_v_s
        if constant is None or current_a is None or torque_nm is None:
            return
        airgap_nm = 1.5 * constant * current_a

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
            (f"{point}_torque_nm", f"{point}_current_a", "flux"),
        )

    def _power_share(self) -> float | None:
        """Return the shaft power at the rated point over its limit, sqrt(3) U I."""
        phase = [1.5, self.dc_bus_voltage_v, self.rated_current_a]
        return _ratio([self.rated_torque_nm, self.rated_speed_rad_s, math.sqrt(3.0)], phase)

    def _of_power(self) -> Iterator[Contradiction]:
        share = self._power_share()
        if share is None or share <= POWER_MAX or self.made_flux:  # with a flux voltage and current say more
            return
        watt = _ratio([self.rated_torque_nm, self.rated_speed_rad_s], []) or 0.0
        yield Contradiction(
            self._named(*_RATED_POINT),
            f"torque and speed make {watt:.4g} W, volts and amperes {watt / share:.4g} VA at most",
            fields=_RATED_POINT,
        )

    def _of_voltage(self) -> Iterator[Contradiction]:
        constant, speed, bus = self.emf_constant_v_s, self.rated_speed_rad_s, self.dc_bus_voltage_v
        if constant is None or speed is None or bus is None:
            return
        emf, most = constant * speed, bus / math.sqrt(3.0)
        if emf > most:
            yield Contradiction(
                f"{self._named('rated_speed_rad_s')} and {self._named('dc_bus_voltage_v')}",
                f"the back-EMF alone has {emf:.4g} V of a phase there, the inverter {most:.4g} V",
                fields=("flux", "rated_speed_rad_s", "dc_bus_voltage_v"),
            )

    def _of_bands(self) -> Iterator[Contradiction]:
        """Check ratios that lie within the same decades for every motor."""
        for band in BANDS:
            value = band.value(self)
            if value is not None and not band.least <= value <= band.most:
                yield Contradiction(
                    self._named(*band.fields),
                    f"{band.title} is {value:.3g}{band.unit}, of every motor within {band.least:g} to "
                    f"{band.most:g}{band.unit}",
                    fields=band.fields,
                )

    @property
    def flux_v_s(self) -> float | None:
        """p phi by a figure of it, else by torque and current of the rated point."""
        if self.made_flux or self.rated_torque_nm is None or self.rated_current_a is None:
            return self.emf_constant_v_s
        return self.rated_torque_nm / (1.5 * self.rated_current_a)

    def _of_times(self) -> Iterator[Contradiction]:
        resistance, constant = self.resistance_ohm, self.emf_constant_v_s
        direct, quadrature, given = self.inductance_d_h, self.inductance_q_h, self.electrical_time_s
        if given is not None and direct and quadrature and resistance:
            electrical = 0.5 * (direct + quadrature) / resistance
            if not agree_within(electrical, given, AGREEING):
                ratio = given / electrical
                halved = any(agree_within(ratio, factor, AGREEING_WELL) for factor in (0.5, 2.0))
                yield Contradiction(
                    f"electrical time constant {1e3 * given:g} ms",
                    f"inductance over resistance is {1e3 * electrical:.4g} ms",
                    "one of the two is of a phase, the other between terminals" if halved else "",
                )  # fmt: skip
        given, inertia = self.mechanical_time_s, self.inertia_kg_m2
        if given is not None and resistance and inertia and constant:
            mechanical = resistance * inertia / (1.5 * constant**2)
            if not agree_within(mechanical, given, 2.0 * AGREEING):  # the flux enters squared
                yield Contradiction(
                    f"mechanical time constant {1e3 * given:g} ms",
                    f"R J/(3/2 (p phi)^2) is {1e3 * mechanical:.4g} ms",
                    _time_explained(given / mechanical),
                )

    def _named(self, *fields: str) -> str:
        """Name the figures with their values and units."""
        values = ((FIELDS[name], getattr(self, name)) for name in fields)
        return ", ".join(f"{title.text} {title.shown(value)}" for title, value in values if value is not None)


_RATED_POINT: Final = ("rated_torque_nm", "rated_speed_rad_s", "rated_current_a", "dc_bus_voltage_v")


class Title(NamedTuple):
    """Display of a field."""

    text: str
    unit: str
    scale: float = 1.0
    """From SI units, and from a peak to rms."""

    def shown(self, value: float) -> str:
        """Format a value with its unit."""
        return f"{value * self.scale:.4g} {self.unit}".rstrip()


FIELDS: Final[Mapping[str, Title]] = {
    "rated_torque_nm": Title("rated torque", "N m"),
    "rated_speed_rad_s": Title("rated speed", "r/min", 30.0 / math.pi),
    "rated_current_a": Title("rated current", "A rms", math.sqrt(0.5)),
    "dc_bus_voltage_v": Title("DC bus", "V"),
    "peak_torque_nm": Title("peak torque", "N m"),
    "peak_current_a": Title("peak current", "A rms", math.sqrt(0.5)),
    "pole_pairs": Title("pole pairs", ""),
    "resistance_ohm": Title("resistance", "ohm"),
    "inductance_d_h": Title("inductance d", "H"),
    "inductance_q_h": Title("inductance q", "H"),
    "inertia_kg_m2": Title("rotor inertia", "kg m^2"),
}


_Figure = Callable[[SheetFigures], float | None]


class Band(NamedTuple):
    """A ratio of figures, with its range over all motors."""

    title: str
    unit: str
    least: float
    most: float
    fields: tuple[str, ...]
    value: _Figure


def _ratio(over: Sequence[float | None], under: Sequence[float | None]) -> float | None:
    """Return the product of the first over that of the second; None if one is not given."""
    given = [each for each in (*over, *under) if each is not None]
    if len(given) < len(over) + len(under):
        return None
    return math.prod(given[: len(over)]) / math.prod(given[len(over) :])


def _drop(figures: SheetFigures) -> float | None:
    """Return R i over the inverter's phase voltage."""
    over = [figures.resistance_ohm, figures.rated_current_a, math.sqrt(3.0)]
    return _ratio(over, [figures.dc_bus_voltage_v])


def _inductance_bands() -> Iterator[Band]:
    for name in ("inductance_d_h", "inductance_q_h"):

        def henry(figures: SheetFigures, name: str = name) -> float | None:
            value: float | None = getattr(figures, name)
            return value

        def time(figures: SheetFigures, henry: _Figure = henry) -> float | None:
            return _ratio([henry(figures)], [figures.resistance_ohm])

        def share(figures: SheetFigures, henry: _Figure = henry) -> float | None:
            over = [henry(figures), figures.rated_current_a, figures.pole_pairs]
            return _ratio(over, [figures.flux_v_s])

        # 15 us of ironless motors of a few watts to some 50 ms of large torque motors.
        yield Band("L/R", " s", 3e-6, 0.5, (name, "resistance_ohm"), time)
        # 0.7 % of ironless motors to some 1 of motors with iron.
        title, fields = "L i over the magnets' flux", (name, "rated_current_a", "pole_pairs")
        yield Band(title, "", 1e-3, 10.0, fields, share)


BANDS: Final = (
    # 3e-3 of motors of 100 kW to 0.3 of small ones.
    Band("R i over the inverter's phase voltage", "", 5e-4, 0.7,
         ("resistance_ohm", "rated_current_a", "dc_bus_voltage_v"),
         _drop),
    *_inductance_bands(),
    # Below one with strong magnets in series, 5 of reluctance machines with few magnets.
    Band("L_q/L_d", "", 0.2, 10.0, ("inductance_d_h", "inductance_q_h"),
         lambda s: _ratio([s.inductance_q_h], [s.inductance_d_h])),
    # Spindles have 2 to 3 kHz.
    Band("frequency in the winding", " Hz", 0.0, 5000.0, ("pole_pairs", "rated_speed_rad_s"),
         lambda s: s.frequency_hz),
    Band("peak over rated current", "", 0.95, 30.0, ("peak_current_a", "rated_current_a"),
         lambda s: _ratio([s.peak_current_a], [s.rated_current_a])),
    Band("peak over rated torque", "", 0.95, 30.0, ("peak_torque_nm", "rated_torque_nm"),
         lambda s: _ratio([s.peak_torque_nm], [s.rated_torque_nm])),
    # Rotors of one shape have torque as the cube and inertia as the fifth power of their length: 2e-5 to
    # 1.1e-3 of published motors from 2 mN m to 100 N m.
    Band("rotor inertia over torque^(5/3)", "", 5e-7, 5e-2, ("inertia_kg_m2", "rated_torque_nm"),
         lambda s: _ratio([s.inertia_kg_m2], [s.rated_torque_nm and s.rated_torque_nm ** (5.0 / 3.0)])),
    # A millisecond to some tenths of a second.
    Band("run-up of the rotor by the rated torque", " s", 5e-5, 5.0,
         ("inertia_kg_m2", "rated_speed_rad_s", "rated_torque_nm"),
         lambda s: _ratio([s.inertia_kg_m2, s.rated_speed_rad_s], [s.rated_torque_nm])),
)  # fmt: skip


def _time_explained(ratio: float) -> str:
    """Explain a time constant. ``ratio``: the one on the sheet over the one that follows."""
    reasons = {2.0: "as if the resistance were entered between terminals and is of a phase",
               0.5: "as if the resistance were entered of a phase and is between terminals"}  # fmt: skip
    near = [text for factor, text in reasons.items() if agree_within(ratio, factor, AGREEING)]
    return near[0] if near else ""
