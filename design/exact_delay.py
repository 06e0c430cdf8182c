"""The largest delay for a wanted gain, also where the gain is so small that only fast loops keep it.

:func:`design.speed_design.largest_delay` starts from gains that keep the wanted figure without delay
and at rest; where the resonance of the current loop alone exceeds it, none does. The least gain
over all feedbacks rises with the delay, so there the delay at which it is the wanted one is sought.
"""

import math

from scipy.optimize import brentq

from design.delay_loop import Array
from design.errors import NoSolution
from design.speed_design import SpeedDesign, delay_within, largest_delay, least_gain
from design.speed_loop import Feedback, SpeedModel

_FIRST_DELAY = 0.1
"""Times the current loop's time constant: where the search begins."""
_SHORTEST = 1e-6
_CLOSE = 1e-7
"""Relative error of the delay that is sought."""


def largest_exact_delay(
    model: SpeedModel,
    gamma: float,
    feedback: Feedback = Feedback.FULL,
    integral_time_s: float | None = None,
) -> SpeedDesign:
    """As :func:`design.speed_design.largest_delay`, by the least gain where that finds no start.

    Raises NoSolution if no delay was found at which ``gamma``, rad/s per N m, can be kept.
    """
    try:
        return largest_delay(model, gamma, feedback, integral_time_s)
    except NoSolution:
        return _by_least_gain(model, gamma, feedback, integral_time_s)


def certified_starts(model: SpeedModel, gamma: float, feedback: Feedback) -> tuple[Array, ...]:
    """Gains from which :func:`design.lmi_design.largest_certified_delay` climbs well."""
    speed = largest_exact_delay(model, gamma, Feedback.SPEED).K
    if feedback is Feedback.SPEED:
        return speed, 1.2 * speed
    return starts_between(largest_exact_delay(model, gamma).K, speed)


def starts_between(full: Array, speed: Array) -> tuple[Array, ...]:
    """The same from the optima with full and with speed feedback."""
    return full, 0.5 * (full + speed), 1.1 * speed


def _by_least_gain(
    model: SpeedModel, gamma: float, feedback: Feedback, integral_time_s: float | None
) -> SpeedDesign:
    found: dict[float, SpeedDesign] = {}

    def excess(log_delay: float) -> float:
        delay_s = math.exp(log_delay)
        found[delay_s] = least_gain(model, delay_s, feedback, integral_time_s)
        return math.log(found[delay_s].gain / gamma)

    time_constant_s = -1.0 / float(model.A[0, 0])
    low = high = math.log(_FIRST_DELAY * time_constant_s)
    while excess(high) < 0.0:
        low, high = high, high + math.log(2.0)
    while low == high or excess(low) > 0.0:
        high, low = low, low - math.log(2.0)
        if low < math.log(_SHORTEST * time_constant_s):
            raise NoSolution(
                f"feedback for a gain of {gamma:g} rad/s per N m",
                "no delay was found at which it can be kept",
            )
    brentq(excess, low, high, xtol=_CLOSE, rtol=_CLOSE)
    kept = [design for design in found.values() if design.gain <= gamma * (1.0 + _CLOSE)]
    best = max(kept, key=lambda design: design.delay_s)
    return SpeedDesign(best.K, max(best.delay_s, delay_within(model, best.K, gamma)), gamma)
