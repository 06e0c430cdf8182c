"""Numbers for JSON and for files."""

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from servobench.design.hinf.margins import Margins

_DIGITS = 6
"""Off by 5e-6 at most, where makers allow their figures 10 %."""


def finite(value: float | None) -> float | None:
    """Return ``value``; None if it is not finite, which JSON cannot express."""
    return value if value is not None and math.isfinite(value) else None


def short(value: float) -> float:
    """Round to six digits, for a file."""
    return float(f"{value:.{_DIGITS}g}")


def margin_figures(margins: "Margins") -> dict[str, float | None]:
    """Return the margins reported for every loop."""
    return {
        name: finite(getattr(margins, name))
        for name in ("gain_margin_db", "phase_margin_deg", "modulus_margin")
    }
