"""A speed feedback behind a coupling, whose resonance is never where a sheet has it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Final

from servobench.design.delay.delay_loop import Feedback, SpeedModel
from servobench.design.delay.delay_norm import hinf_norm
from servobench.design.errors import NoSolution
from servobench.design.motor import PmsmParameters
from servobench.design.speed.speed_design import SpeedDesign, least_gain

COUPLINGS: Final[Mapping[str, float]] = {"resonances_90_percent": 0.9, "resonances_110_percent": 1.1}
"""Multiples of both frequencies of a coupling: what a sheet's stiffness and a belt's tension leave open."""
_SLOWER: Final = (1.0, 1.2, 1.5, 2.0, 3.0, 5.0)
"""Multiples of the delay for which a feedback is tried: one for a longer delay has a lower bandwidth."""


def couplings_off(motor: PmsmParameters) -> dict[str, PmsmParameters]:
    """Return the motor with other couplings, by the names of their figures; none on a rigid shaft."""
    mechanism = motor.mechanism
    if mechanism is None or mechanism.coupling is None:
        return {}
    shaft = mechanism.coupling
    return {
        name: replace(motor, mechanism=replace(mechanism, coupling=shaft.with_resonance(share)))
        for name, share in COUPLINGS.items()
    }


def least_gain_over(
    models: Sequence[SpeedModel], delay_s: float, feedback: Feedback, integral_time_s: float | None = None
) -> SpeedDesign:
    """Of feedbacks that are best for one of the ``models``, or for its rigid shaft, at this delay or a longer
    one, return that whose norm over all of them is least; told is that of the first. Error: NoSolution."""
    found: list[tuple[float, SpeedDesign]] = []
    rigid = [model.rigid for model in models[:1] if model.rigid is not None]
    for times in _SLOWER:
        for model in (*models, *rigid):
            K = least_gain(model, times * delay_s, feedback, integral_time_s).K
            norms = [hinf_norm(each.loop(K, delay_s)) for each in models]
            found.append((max(norms), SpeedDesign(K, delay_s, norms[0])))
    worst, design = min(found, key=itemgetter(0))
    if math.isinf(worst):
        what = f"feedback for {len(models)} plants and a delay of {delay_s * 1e3:g} ms"
        raise NoSolution(what, "none that was tried is stable with all of them")
    return design
