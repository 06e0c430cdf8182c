"""How fast the simulated drive's current loops are if nothing else is asked for."""

from typing import Final

INNER_RATE_OVER_BANDWIDTH: Final = 20
"""PI loops that sample twenty times faster than their bandwidth, with 1.5 periods of delay, keep a phase
margin of 90 - 360 * 1.5 / 20 = 63 degrees."""


def current_bandwidth_hz(asked_hz: float | None, inner_rate_hz: int) -> float:
    """Return the bandwidth of the PI current loops, Hz; ``asked_hz`` None: default for ``inner_rate_hz``."""
    return inner_rate_hz / INNER_RATE_OVER_BANDWIDTH if asked_hz is None else asked_hz
