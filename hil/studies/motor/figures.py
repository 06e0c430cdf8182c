"""Possible figures of a motor's data sheet, each in its convention."""

import re
from collections.abc import Mapping
from typing import NamedTuple

_NM: Mapping[str, float] = {"nm": 1.0, "ncm": 1e-2, "mnm": 1e-3, "ozin": 7.0615518e-3, "lbin": 0.11298483}
_KG_M2: Mapping[str, float] = {
    "kgm2": 1.0, "kgcm2": 1e-4, "gcm2": 1e-7, "ozins2": _NM["ozin"], "lbins2": _NM["lbin"],
}  # fmt: skip
_V_KRPM: Mapping[str, float] = {"v/krpm": 1.0, "mv/rpm": 1.0, "v/rpm": 1e3, "v/(rad/s)": 104.719755}
_OHM: Mapping[str, float] = {"ohm": 1.0, "mohm": 1e-3}
_MH: Mapping[str, float] = {"mh": 1.0, "uh": 1e-3}


class SheetFigure(NamedTuple):
    """One possible figure of a sheet."""

    key: str
    """Also the option, with hyphens: ``--resistance-line-ohm``."""
    group: str
    """Figures of one group replace each other."""
    text: str
    units: Mapping[str, float] = {}
    """Units that a number may come with -> that unit in the figure's own."""

    def number(self, entered: str) -> float:
        """Convert an entry, ``16.74 oz-in`` or a bare number, to the figure's own unit. Raises ValueError."""
        parts = re.fullmatch(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)(.*)", entered)
        unit = re.sub(r"[\s*^·-]|/A\w*$", "", parts[2]).lower() if parts else ""
        if parts is None or (unit and unit not in self.units):
            known = f", bare or in {', '.join(self.units)}" if self.units else ""
            raise ValueError(f"{entered!r} is not a number{known}")
        return float(parts[1]) * (self.units[unit] if unit else 1.0)


class SheetGroup(NamedTuple):
    """A required quantity, given in one way or another."""

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
    SheetFigure("r_line_ohm", "resistance", "between two terminals, ohm", _OHM),
    SheetFigure("r_phase_ohm", "resistance", "of a phase, ohm", _OHM),
    SheetFigure("l_line_mh", "inductance", "between two terminals, mH", _MH),
    SheetFigure("l_phase_mh", "inductance", "of a phase (d axis), mH", _MH),
    SheetFigure("lq_phase_mh", "inductance_q", "of a phase on the q axis, mH", _MH),
    SheetFigure("kt_nm_arms", "flux", "torque per line current, N m per A rms", _NM),
    SheetFigure("kt_nm_apk", "flux", "torque per line current, N m per A of the sine's peak", _NM),
    SheetFigure("kt_nm_adc", "flux", "torque per DC current of a six-step drive, N m/A", _NM),
    SheetFigure("ke_line_vrms_krpm", "flux", "between terminals, V rms per 1000 r/min", _V_KRPM),
    SheetFigure("ke_line_vpk_krpm", "flux", "between terminals, V peak per 1000 r/min", _V_KRPM),
    SheetFigure("ke_phase_vrms_krpm", "flux", "of a phase, V rms per 1000 r/min", _V_KRPM),
    SheetFigure("ke_phase_vpk_krpm", "flux", "of a phase, V peak per 1000 r/min", _V_KRPM),
    SheetFigure("kv_rpm_vdc", "flux", "speed per DC voltage of a six-step drive, r/min per V"),
    SheetFigure("kv_rpm_vpk", "flux", "speed per peak voltage between terminals, r/min per V"),
    SheetFigure("inertia_kg_cm2", "inertia", "moment of inertia, kg cm^2"),
    SheetFigure("inertia_kg_m2", "inertia", "moment of inertia, kg m^2", _KG_M2),
    SheetFigure("rated_torque_nm", "torque", "N m", _NM),
    SheetFigure("rated_speed_rpm", "speed", "r/min"),
    SheetFigure("rated_current_arms", "current", "A rms"),
    SheetFigure("rated_current_apk", "current", "A of the sine's peak"),
    SheetFigure("peak_current_arms", "peak", "A rms"),
    SheetFigure("peak_current_apk", "peak", "A of the sine's peak"),
    SheetFigure("peak_torque_nm", "peak", "N m", _NM),
    SheetFigure("dc_bus_v", "bus", "V"),
    SheetFigure("friction_nm", "friction", "N m", _NM),
    SheetFigure("viscous_nm_krpm", "viscous", "N m per 1000 r/min"),
    SheetFigure("tau_electrical_ms", "electrical", "ms"),
    SheetFigure("tau_mechanical_ms", "mechanical", "ms"),
)
SEVERAL = ("flux", "peak")
"""Groups for which a sheet may give several figures, which are compared."""


def option(key: str) -> str:
    """Return the option of a figure."""
    return "--" + key.replace("_", "-")


def missing(values: Mapping[str, float]) -> list[str]:
    """Return required groups without any figure."""
    given = {figure.group for figure in FIGURES if figure.key in values}
    return [name for name, group in GROUPS.items() if group.needed and name not in given]


def ways(group: str) -> list[SheetFigure]:
    """Return the figures of a group."""
    return [figure for figure in FIGURES if figure.group == group]
