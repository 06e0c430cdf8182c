"""Analysis of the loop as it runs: its decay and its gain, certified and found.

Two kinds of statement, kept apart. What is *certified* holds under every admissible sequence of losses and
delays. A figure *found* is reached under one of them, a pattern from a search: no certificate can be better,
and the truth lies between the two.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.delay.speed_loop import SpeedModel
from servobench.design.errors import NoSolution
from servobench.design.sampled.admissible_steps import Delivery
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy, SwitchedLoop
from servobench.design.sampled.loss_patterns import (
    Pattern,
    WorstGain,
    pattern_gains,
    repeated,
    slowest_pattern,
    worst_gain,
)
from servobench.design.sampled.peak_certificate import certify_peak
from servobench.design.sampled.sequence_certificate import SequenceCertificate, certify_decay, certify_gain
from servobench.design.sampled.worst_peak import worst_peak


@dataclass(frozen=True, slots=True, eq=False)
class SampledAnalysis:
    """The figures of one sampled loop."""

    loop: SwitchedLoop
    regular: list[Pattern]
    """Patterns with d lost of every d + 1, all others delayed by T: for each d from 0 to D."""
    gains: list[float]
    """Gain from load torque to speed error under each of them, rad/s per N m; inf where unstable."""
    slowest: Pattern
    """The periodic pattern of least decay that the search found."""
    worst: WorstGain
    """The pattern of largest gain."""
    decay_proof: SequenceCertificate | None
    """None: not even stability could be certified for every sequence."""
    gain_proof: SequenceCertificate | None
    without_certificate: str = ""
    """Reason, if there is no certificate."""
    peak_found: float = math.nan
    """Largest error reached after a load step of 1 N m, rad/s; nan: not searched."""
    peak_certified: float | None = None
    """Error that no sequence exceeds, rad/s; None: not proved."""

    @property
    def patterns(self) -> list[Pattern]:
        """The worst known patterns."""
        return [self.worst.pattern, self.slowest, *self.regular]

    @property
    def network(self) -> SampledNetwork:
        """The loop's network."""
        return self.loop.network

    @property
    def decay_found_per_s(self) -> float:
        """Least decay that was found, 1/s; negative: unstable."""
        return self.slowest.decay_per_s

    @property
    def decay_certified_per_s(self) -> float | None:
        """Decay under every sequence, 1/s."""
        return None if self.decay_proof is None else self.decay_proof.figure

    @property
    def gain_found(self) -> float:
        """Largest gain that was found, rad/s per N m; inf: unstable."""
        return self.worst.gain

    @property
    def gain_certified(self) -> float | None:
        """Gain that no sequence exceeds, rad/s per N m."""
        return None if self.gain_proof is None else self.gain_proof.figure

    @property
    def certified(self) -> bool:
        """True if decay and gain are proved under every admissible sequence."""
        return bool(self.decay_certified_per_s) and self.gain_certified is not None

    @property
    def refuted(self) -> bool:
        """True if an admissible pattern is known that makes the loop unstable."""
        return self.slowest.decay_per_s <= 0.0


def analyse_sampled(model: SpeedModel, K: Array, network: SampledNetwork) -> SampledAnalysis:
    """Compute everything in :class:`SampledAnalysis` for u = K x."""
    return analyse_loop(HeldLoop(model, np.asarray(K, dtype=float), network))


def analyse_loop(loop: SwitchedLoop, remembering: Sequence[bool] = (False, True)) -> SampledAnalysis:
    """Analyse any loop; ``remembering``: options to try, as for :func:`certify_gain`."""
    regular = regular_patterns(loop)
    gains = pattern_gains(loop, regular).tolist()
    slowest = min([slowest_pattern(loop), *regular], key=lambda pattern: pattern.decay_per_s)
    if slowest.decay_per_s <= 0.0:
        why = "a pattern is known that destabilises it"
        worst = WorstGain(slowest, math.inf)
        return SampledAnalysis(loop, regular, gains, slowest, worst, None, None, why)
    worst = worst_gain(loop, [*regular, slowest])
    patterns = [worst.pattern, slowest, *regular]
    decay_proof, gain_proof, why = None, None, ""
    try:
        decay_proof = certify_decay(loop, patterns, worst.gain, remembering)
        gain_proof = certify_gain(loop, patterns, worst.gain, remembering)
    except NoSolution as error:
        why = str(error)
    if not why and (decay_proof is None or gain_proof is None):
        why = "no quadratic functions were found that fall along every sequence"
    return SampledAnalysis(loop, regular, gains, slowest, worst, decay_proof, gain_proof, why)


def with_peak(analysis: SampledAnalysis) -> SampledAnalysis:
    """Add the largest error after a load step, for u = K x."""
    assert isinstance(analysis.loop, HeldLoop)
    if analysis.refuted:
        return replace(analysis, peak_found=math.inf)
    reached = worst_peak(analysis.loop)
    bound = None
    if analysis.decay_certified_per_s:
        with suppress(NoSolution):
            bound = certify_peak(
                analysis.loop, analysis.patterns, analysis.gain_found, analysis.decay_certified_per_s, reached
            )
    if bound is None:
        return replace(analysis, peak_found=reached)
    return replace(analysis, peak_found=max(reached, bound.reached), peak_certified=bound.certified)


def regular_patterns(loop: SwitchedLoop) -> list[Pattern]:
    """Return patterns with d lost of every d + 1 for d = 0 .. D, each delay T; with history losses do not
    matter."""
    network = loop.network
    most = 0 if network.strategy is Strategy.HISTORY else network.losses_max
    return [repeated(loop, (Delivery(d + 1, network.delay_max_s),)) for d in range(most + 1)]
