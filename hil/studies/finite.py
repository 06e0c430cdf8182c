"""Numbers for JSON."""

import math


def finite(value: float) -> float | None:
    """``value``; None if it is not finite, which JSON has no word for."""
    return value if math.isfinite(value) else None
