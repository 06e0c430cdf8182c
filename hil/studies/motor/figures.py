"""Which figures a data sheet may give of a motor, each in its convention."""

from collections.abc import Mapping
from typing import NamedTuple


class SheetFigure(NamedTuple):
    """One figure that a sheet may give."""

    key: str
    """Also the option, with hyphens: ``--resistance-line-ohm``."""
    group: str
    """Figures of one group stand for each other."""
    text: str


class SheetGroup(NamedTuple):
    """What has to be known, in one way or another."""

    question: str
    needed: bool = True


GROUPS: Mapping[str, SheetGroup] = {
    "poles": SheetGroup("How many poles"),
    "resistance": SheetGroup("Winding resistance"),
    "inductance": SheetGroup("Winding inductance"),
    "flux": SheetGroup("Torque, back-EMF or speed constant"),
    "inertia": SheetGroup("Rotor inertia"),
    "torque": SheetGroup("Rated (continuous) torque"),
    "speed": SheetGroup("Rated speed"),
    "peak": SheetGroup("Peak current or torque"),
    "bus": SheetGroup("Voltage of the inverter's DC bus"),
    "current": SheetGroup("Current of the rated torque", needed=False),
    "inductance_q": SheetGroup("q-axis inductance of a phase, if it differs", needed=False),
    "friction": SheetGroup("Static friction", needed=False),
    "viscous": SheetGroup("Viscous friction", needed=False),
    "electrical": SheetGroup("Electrical time constant", needed=False),
    "mechanical": SheetGroup("Mechanical time constant", needed=False),
}
FIGURES = (
    SheetFigure("poles", "poles", "number of poles"),
    SheetFigure("pole_pairs", "poles", "number of pole pairs"),
    SheetFigure("r_line_ohm", "resistance", "between two terminals, ohm"),
    SheetFigure("r_phase_ohm", "resistance", "of a phase, ohm"),
    SheetFigure("l_line_mh", "inductance", "between two terminals, mH"),
    SheetFigure("l_phase_mh", "inductance", "of a phase (d axis), mH"),
    SheetFigure("lq_phase_mh", "inductance_q", "of a phase on the q axis, mH"),
    SheetFigure("kt_nm_arms", "flux", "torque per line current, N m per A rms"),
    SheetFigure("kt_nm_apk", "flux", "torque per line current, N m per A of the sine's peak"),
    SheetFigure("kt_nm_adc", "flux", "torque per DC current of a six-step drive, N m/A"),
    SheetFigure("ke_line_vrms_krpm", "flux", "between terminals, V rms per 1000 r/min"),
    SheetFigure("ke_line_vpk_krpm", "flux", "between terminals, V peak per 1000 r/min"),
    SheetFigure("ke_phase_vrms_krpm", "flux", "of a phase, V rms per 1000 r/min"),
    SheetFigure("ke_phase_vpk_krpm", "flux", "of a phase, V peak per 1000 r/min"),
    SheetFigure("kv_rpm_vdc", "flux", "speed per DC voltage of a six-step drive, r/min per V"),
    SheetFigure("kv_rpm_vpk", "flux", "speed per peak voltage between terminals, r/min per V"),
    SheetFigure("inertia_kg_cm2", "inertia", "moment of inertia, kg cm^2"),
    SheetFigure("inertia_kg_m2", "inertia", "moment of inertia, kg m^2"),
    SheetFigure("rated_torque_nm", "torque", "N m"),
    SheetFigure("rated_speed_rpm", "speed", "r/min"),
    SheetFigure("rated_current_arms", "current", "A rms"),
    SheetFigure("rated_current_apk", "current", "A of the sine's peak"),
    SheetFigure("peak_current_arms", "peak", "A rms"),
    SheetFigure("peak_current_apk", "peak", "A of the sine's peak"),
    SheetFigure("peak_torque_nm", "peak", "N m"),
    SheetFigure("dc_bus_v", "bus", "V"),
    SheetFigure("friction_nm", "friction", "N m"),
    SheetFigure("viscous_nm_krpm", "viscous", "N m per 1000 r/min"),
    SheetFigure("tau_electrical_ms", "electrical", "ms"),
    SheetFigure("tau_mechanical_ms", "mechanical", "ms"),
)
SEVERAL = ("flux", "peak")
"""Groups of which a sheet may give several figures, that are held against each other."""


def option(key: str) -> str:
    """The option of a figure."""
    return "--" + key.replace("_", "-")


def missing(values: Mapping[str, float]) -> list[str]:
    """Groups of which nothing was given, though something is needed."""
    given = {figure.group for figure in FIGURES if figure.key in values}
    return [name for name, group in GROUPS.items() if group.needed and name not in given]


def ways(group: str) -> list[SheetFigure]:
    """The figures of a group."""
    return [figure for figure in FIGURES if figure.group == group]
