"""Whether the current loop of a bench's drive is fast enough for the PID around it.

A PID has no certificate. What can be told before the run is the phase that a slower current loop takes from
it at its crossover; where its file does not say what it was tuned for, the rule of cascaded loops is left.
"""

import math
from collections.abc import Collection, Iterator
from typing import Final

from design.motor import PmsmParameters
from hil.configuration.config import BenchConfig
from hil.configuration.controller_kinds import PidController
from hil.configuration.drive_current_loop import KnownLoop, current_loop_of

_PHASE_LOST_DEG: Final = 5.0
"""Of a margin of 50 degrees, the rule's: from here on the answer to a load step is visibly another."""
_CASCADE: Final = 5.0
"""Inner bandwidth over outer crossover, at least: the inner loop then costs 11 degrees there."""
_LOWEST_RAD_S, _HIGHEST_RAD_S, _BISECTIONS = 1e-3, 1e6, 60


def slow_loops(config: BenchConfig, replaced: Collection[str], simulated: bool) -> Iterator[str]:
    """A sentence for each axis whose current loop is too slow for its PID.

    ``replaced``: axes whose controller is not the bench's; ``simulated``: the bench makes its drives itself.
    """
    for axis in config.axes:
        controller = config.drive[axis].controller
        if axis in replaced or not isinstance(controller, PidController):
            continue
        own = current_loop_of(config, axis, simulated=simulated)
        if own is None:
            continue
        text = _told(controller, own, config.drive[axis].motor.parameters)
        if text:
            yield f"{axis}: {text}"


def _told(pid: PidController, own: KnownLoop, motor: PmsmParameters) -> str:
    that = f"that of this drive has {own.bandwidth_hz:.4g} Hz ({own.key})"
    own_rad_s = math.tau * own.bandwidth_hz
    if pid.made_for is None:
        crossover = crossover_rad_s(pid, motor)
        if own_rad_s >= _CASCADE * crossover:
            return ""
        needed_hz = _CASCADE * crossover / math.tau
        return (
            f"its PID crosses over at {crossover:.4g} rad/s, which asks for a current loop of "
            f"{needed_hz:.4g} Hz or more, five times as fast; {that}"
        )
    crossover, made_hz = pid.made_for.crossover_rad_s, pid.made_for.current_loop.bandwidth_hz
    lost_deg = math.degrees(math.atan(crossover / own_rad_s) - math.atan(crossover / (math.tau * made_hz)))
    if lost_deg < _PHASE_LOST_DEG:
        return ""
    return (
        f"its PID crosses over at {crossover:.4g} rad/s, tuned for a current loop of {made_hz:.4g} Hz; "
        f"{that}, which takes about {lost_deg:.0f} degrees from its phase margin"
    )


def crossover_rad_s(pid: PidController, motor: PmsmParameters) -> float:
    """The highest frequency at which PID and shaft have gain 1, the current loop and delays left out."""

    def gain(omega: float) -> float:
        s = 1j * omega
        derivative = pid.derivative_nm_s2_rad * s / (1.0 + pid.derivative_filter_s * s)
        shaft = motor.inertia_kg_m2 * s + motor.viscous_friction_nm_s
        return abs((pid.proportional_nm_s_rad + pid.integral_nm_rad / s + derivative) / shaft)

    low, high = math.log(_LOWEST_RAD_S), math.log(_HIGHEST_RAD_S)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if gain(math.exp(middle)) > 1.0 else (low, middle)
    return math.exp(low)
