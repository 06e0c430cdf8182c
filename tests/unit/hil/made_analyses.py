"""Analyses of sampled loops with figures that a test chooses."""

import math
from typing import Any

import numpy as np

from servobench.design.hinf.margins import Margins
from servobench.design.sampled.admissible_steps import Delivery, steps_of
from servobench.design.sampled.analysis import SampledAnalysis
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.design.sampled.loss_patterns import Pattern, WorstGain
from servobench.design.sampled.sequence_certificate import SequenceCertificate

STAMP = SampledNetwork(Strategy.STAMP, 0.01, 2, 0.004, 0.01)
ARRIVAL = SampledNetwork(Strategy.ARRIVAL, 0.002, 1, 0.0005)


def _pattern(lost: int, decay_per_s: float) -> Pattern:
    """So many samples lost after each that comes."""
    return Pattern(steps_of(STAMP, [Delivery(lost + 1, 0.01)]), decay_per_s)


SLOWEST, REGULAR = _pattern(2, 4.0), [_pattern(0, 9.0), _pattern(1, 6.0)]
WORST = _pattern(1, 5.0)
DECAY_PROOF = SequenceCertificate([np.eye(2)], 3e-4, 3.0)
GAIN_PROOF = SequenceCertificate([2.0 * np.eye(2), 3.0 * np.eye(2)], 2e-4, 125.0)
MARGINS = Margins(6.0, 50.0, 45.0, 30.0, 0.6, 20.0)


class _Loop:
    """What an analysis asks of its loop."""

    def __init__(self, network: SampledNetwork) -> None:
        self.network = network


def made_analysis(network: SampledNetwork = STAMP, **changes: Any) -> SampledAnalysis:
    """Certified at a gain of 125 and a decay of 3; found 100 and 4."""
    fields: dict[str, Any] = {
        "loop": _Loop(network),
        "regular": REGULAR,
        "gains": [90.0, 95.0],
        "slowest": SLOWEST,
        "worst": WorstGain(WORST, 100.0),
        "decay_proof": DECAY_PROOF,
        "gain_proof": GAIN_PROOF,
        "peak_found": 40.0,
        "peak_certified": 50.0,
    }
    return SampledAnalysis(**(fields | changes))


def unproved(why: str = "no proof", network: SampledNetwork = STAMP) -> SampledAnalysis:
    """Unstable under a pattern that is known."""
    return made_analysis(
        network,
        gains=[90.0, math.inf],
        slowest=_pattern(2, -1.0),
        worst=WorstGain(WORST, math.inf),
        decay_proof=None,
        gain_proof=None,
        without_certificate=why,
        peak_found=math.inf,
        peak_certified=None,
    )
