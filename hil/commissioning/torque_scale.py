"""The torque scale: basis of every torque of a commissioning, and its uncertainty.

6077h and 6071h count in thousandths of the rated torque 6076h, and nothing on the bus measures a torque:
inertia, friction and gains are in proportion to that rating. The flux is its only witness, for volts and
amperes are measured by the drive: 3/sqrt(2) times p phi, in V s, is N m per A rms.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any, Final

from servobench.design.motor import AGREEING
from servobench.hil.commissioning.findings import Findings
from servobench.hil.commissioning.nameplate import CONSTANT_QUANTITY
from servobench.hil.commissioning.request import Nameplate

TORQUE_PER_VOLTAGE: Final = 1.5 * math.sqrt(2.0)
"""N m per A rms over V s/rad (a phase's peak), of three phases."""
RATED_CURRENT: Final = 0.05
"""k = 2, relative: 6075h in mA and a plate's three digits, and the error of a drive's current sensors."""
_PROPORTIONAL: Final = ("N m", "kg m^2")
"""Units of figures that are in proportion to the torque."""


@dataclass(frozen=True, slots=True)
class TorqueScale:
    """The rated torque that sets the unit of all torques."""

    rated_torque_nm: float
    by: str
    """Its source."""
    witness: str = ""
    """The figure compared with it; empty: none."""
    ratio: float | None = None
    """The rated torque by the witness, over this one."""
    uncertainty: float | None = None
    """Expanded uncertainty of the ratio, k = 2; None without a witness: the torque's error is unknown."""
    measured: bool = False
    """True if the witness was measured, not only printed."""

    @property
    def sentence(self) -> str:
        """Sentence for figures that depend on it."""
        rests = f"rests on the rated torque of {self.by}, {self.rated_torque_nm:.4g} N m"
        if self.ratio is None or self.uncertainty is None:
            return f"{rests}, which nothing measured"
        held = f"{self.witness} makes {self.ratio * self.rated_torque_nm:.4g} N m of the rated current"
        percent = f"+- {100.0 * self.uncertainty:.2g} %"
        if self.measured:
            return f"{rests}; {held}, {percent} (k = 2)"
        return f"{rests}, which nothing measured; {held}, {percent}"

    def as_json(self) -> dict[str, Any]:
        """Return it for programs."""
        return {**asdict(self), "sentence": self.sentence}


def torque_scale(findings: Findings, plate: Nameplate) -> TorqueScale | None:
    """Return the scale known so far; None before the units are read."""
    if findings.told is None:
        return None
    printed, overridden = plate.rating.torque_nm, findings.override.rated_torque_nm
    rated_nm = overridden or findings.told.rated_torque_nm
    by = "the nameplate" if overridden else "6076h"
    if not overridden and printed is not None and abs(rated_nm / printed - 1.0) <= RATED_CURRENT:
        by = "6076h and the nameplate"
    current_a = findings.rated_current_a or plate.rating.current_a
    if current_a is None:
        return TorqueScale(rated_nm, by)
    if findings.voltage_constant is not None:
        constant, error = findings.voltage_constant
        ratio = TORQUE_PER_VOLTAGE * constant * current_a / rated_nm
        uncertainty = math.hypot(error / constant, RATED_CURRENT)
        return TorqueScale(rated_nm, by, "the measured voltage constant", ratio, uncertainty, measured=True)
    figures, told = plate.figures, findings.motor.figures.get(CONSTANT_QUANTITY)
    if figures.emf_constant_v_s is not None:
        ratio = TORQUE_PER_VOLTAGE * figures.emf_constant_v_s * current_a / rated_nm
        return TorqueScale(rated_nm, by, f"the nameplate's {figures.made_flux}", ratio, AGREEING)
    if told is not None and told.convention != "own":
        ratio = told.value * current_a / rated_nm
        return TorqueScale(rated_nm, by, f"the torque constant {told.object}", ratio, AGREEING)
    return TorqueScale(rated_nm, by)


def is_proportional(unit: str) -> bool:
    """Return True for a figure in ``unit`` that is proportional to the torque scale."""
    return any(each in unit for each in _PROPORTIONAL)
