"""Analysis of the loop as it runs: its decay and its gain, certified and found.

Two kinds of statement, kept apart. What is *certified* holds under every admissible sequence of losses and
delays. A figure *found* is reached under one of them, a pattern from a search: no certificate can be better,
and the truth lies between the two.

Searches over sequences for the largest speed error after a load step in a sampled loop.

The load steps by 1 N m at rest, somewhere in a period; from then on the network does its worst. A beam keeps,
period by period, the sequences whose error is largest now, and those in which it grows fastest. The error
found is reached: no bound for every sequence can be lower. It proves no upper bound.
"""

import itertools
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from servobench.design.delay.delay_loop import Array, SpeedModel
from servobench.design.errors import NoSolution
from servobench.design.sampled.admissible_steps import Delivery, families
from servobench.design.sampled.held_loop import HeldLoop, PeriodStep, SampledNetwork, Strategy, SwitchedLoop
from servobench.design.sampled.loss_patterns import (
    Pattern,
    WorstGain,
    pattern_gains,
    repeated,
    slowest_pattern,
    with_uneven_periods,
    worst_gain,
)
from servobench.design.sampled.peak_certificate import certify_peak
from servobench.design.sampled.sequence_certificate import (
    REMEMBERED,
    SequenceCertificate,
    certify_decay,
    certify_gain,
)


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


def analyse_loop(loop: SwitchedLoop, remembered: Sequence[int] = REMEMBERED) -> SampledAnalysis:
    """Analyse any loop; ``remembered``: as for :func:`certify_gain`."""
    regular = regular_patterns(loop)
    gains = pattern_gains(loop, regular).tolist()
    slowest = min([slowest_pattern(loop), *regular], key=lambda pattern: pattern.decay_per_s)
    if loop.network.uneven_s:
        uneven = with_uneven_periods(loop, slowest)
        slowest = min([slowest, *uneven], key=lambda pattern: pattern.decay_per_s)
    if slowest.decay_per_s <= 0.0:
        why = "a pattern is known that destabilises it"
        worst = WorstGain(slowest, math.inf)
        return SampledAnalysis(loop, regular, gains, slowest, worst, None, None, why)
    worst = worst_gain(loop, [*regular, slowest])
    if loop.network.uneven_s:
        uneven = with_uneven_periods(loop, worst.pattern)
        by_gain = [
            WorstGain(*each) for each in zip(uneven, pattern_gains(loop, uneven).tolist(), strict=True)
        ]
        worst = max([worst, *by_gain], key=lambda each: each.gain)
    patterns = [worst.pattern, slowest, *regular]
    decay_proof, gain_proof, why = None, None, ""
    try:
        decay_proof = certify_decay(loop, patterns, worst.gain, remembered)
        gain_proof = certify_gain(loop, patterns, worst.gain, remembered)
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
    if analysis.network.uneven_s:
        return analysis  # peaks are of even periods
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


_BEAM = 150
"""Sequences kept for each node and each of the two orders."""
_PHASES = (0.0, 0.25, 0.5, 0.75)
"""Parts of a period after a sample at which the load steps."""
_ENDS = (0.0, 1.0)
"""Parts of its window at which a switching is tried."""
_INSTANTS = 8
"""Instants between two switchings at which the error is evaluated."""
_PERIODS_MIN = 40
"""For ages below five periods; six loops reach their peak within 10."""
_AGES = 8
"""The search lasts this many of the largest ages, and a few periods at least."""


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """A period under load: map of [xi, 1] (kept + 1, kept + 1), and rows of the error within it."""

    source: int
    target: int
    M: Array
    errors: Array


def worst_peak(loop: HeldLoop) -> float:
    """Return the largest error found, rad/s per N m."""
    steps = [_under_load(loop, step) for family in families(loop.network) for step in family.over(_ENDS)]
    h, k = loop.network.period_s, loop.kept
    periods = max(_PERIODS_MIN, int(_AGES * loop.network.age_max_s / h))
    model = loop.model
    rest = np.linalg.solve(model.A + np.outer(model.B1, loop.K), -model.B2)
    best = abs(float(model.C @ rest))
    for phase in _PHASES:
        rest_s = (1.0 - phase) * h
        start = np.append(np.zeros(k), 1.0)
        start[: len(loop.model.A)] = (_loaded(loop, rest_s) @ np.append(np.zeros(loop.size), 1.0))[
            : len(loop.model.A)
        ]
        beams = {node: start[None, :] for node in {step.source for step in steps}}
        for _ in range(periods):
            reached: dict[int, list[Array]] = {}
            for step in steps:
                if step.source not in beams:
                    continue
                states = beams[step.source]
                best = max(best, float(np.max(np.abs(states @ step.errors.T))))
                reached.setdefault(step.target, []).append(states @ step.M.T)
            beams = {node: _kept(loop, np.vstack(states)) for node, states in reached.items()}
    return best


def _kept(loop: HeldLoop, states: Array) -> Array:
    """Return the states of largest error and of its largest slope, either sign."""
    n = len(loop.model.A)
    error = states[:, :n] @ loop.model.C
    slope = states[:, :n] @ (loop.model.C @ loop.model.A)
    chosen: set[int] = set()
    for order in (
        np.argsort(-np.abs(error), kind="stable"),
        np.argsort(-slope * np.sign(error), kind="stable"),
    ):
        chosen |= set(order[:_BEAM].tolist())
    return np.asarray(states[sorted(chosen)])


def _loaded(loop: HeldLoop, length_s: float) -> Array:
    """Return the flow of [xi, 1] under a load of 1 N m."""
    size = loop.size
    F = np.zeros((size + 1, size + 1))
    F[:size, :size] = loop.generator
    F[: len(loop.model.A), size] = loop.model.B2
    return np.asarray(expm(F * length_s))


def _under_load(loop: HeldLoop, step: PeriodStep) -> _Step:
    size, k = loop.size, loop.kept
    total = np.zeros((size + 1, k + 1))
    total[:k, :k], total[size, k] = np.eye(k), 1.0
    jumps = [loop.sampling, *(loop.applying(switch.back) for switch in step.switches)]
    instants = [0.0, *(switch.at_s for switch in step.switches), loop.network.period_s]
    C = np.append(loop.model.C, np.zeros(size + 1 - len(loop.model.C)))
    errors = []
    for J, (begin_s, end_s) in zip(jumps, itertools.pairwise(instants), strict=True):
        total[:size] = J @ total[:size]
        flow = _loaded(loop, max(0.0, end_s - begin_s) / _INSTANTS)
        for _ in range(_INSTANTS):
            total = flow @ total
            errors.append(C @ total)
    M = np.zeros((k + 1, k + 1))
    M[:k], M[k] = total[:k], total[size]
    return _Step(step.source, step.target, M, np.array(errors))
