"""Numbers for JSON and for files."""

import math

_DIGITS = 6


def finite(value: float) -> float | None:
    """``value``; None if it is not finite, which JSON has no word for."""
    return value if math.isfinite(value) else None


def short(value: float) -> float:
    """With six digits, for a file."""
    return float(f"{value:.{_DIGITS}g}")
