"""Random sampled loops of few nodes, whose largest error brute force can find."""

import itertools

import numpy as np
from scipy.linalg import expm

from servobench.design.sampled.admissible_steps import families, node_count
from servobench.design.sampled.analysis import regular_patterns, worst_peak
from servobench.design.sampled.held_loop import HeldLoop
from servobench.design.sampled.loss_patterns import pattern_gains, slowest_pattern
from servobench.design.sampled.peak_certificate import certify_peak
from servobench.design.sampled.sequence_certificate import certify_decay
from tests.unit.design.random_loops import random_loop


def brute_force(loop: HeldLoop, periods: int, phase: float) -> float:
    """The largest error over all sequences whose moments of switching are at the ends of their windows.

    By its own simulation of xi in small steps, the load beginning ``phase`` of a period before a sample.
    """
    h, k, n = loop.network.period_s, loop.kept, len(loop.model.A)
    size = loop.size
    F = np.zeros((size + 1, size + 1))
    F[:size, :size] = loop.generator
    F[:n, size] = loop.model.B2
    states = {
        node: [np.append(expm(F * phase * h)[:size, size], 1.0)] for node in range(node_count(loop.network))
    }
    worst = 0.0
    for _ in range(periods):
        reached: dict[int, list[np.ndarray]] = {}
        for family in families(loop.network):
            ends = [(window.first_s, window.last_s) for window in family.windows]
            for times in itertools.product(*ends):
                if list(times) != sorted(times) or family.source not in states:
                    continue
                X = np.array(states[family.source]).T.copy()
                X[:size] = loop.sampling @ X[:size]
                at_s = 0.0
                for time_s, window in [*zip(times, family.windows, strict=True), (h, None)]:
                    for _ in range(4):
                        X = expm(F * (time_s - at_s) / 4) @ X
                        worst = max(worst, float(np.max(np.abs(loop.model.C @ X[:n]))))
                    at_s = time_s
                    if window is not None:
                        X[:size] = loop.applying(window.back) @ X[:size]
                X[k:size] = 0.0
                reached.setdefault(family.target, []).extend(X.T)
        states = reached
    return worst


def peaks_of(seed: int) -> tuple[float, float, float]:
    """Certified, found, and the largest by brute force of the first stable loop that ``seed`` draws."""
    draw = np.random.default_rng(seed)
    while True:
        loop = random_loop(draw, delay_periods=1.0, losses_below=3, crossing_min=0.2)
        slowest = slowest_pattern(loop)
        if slowest.decay_per_s <= 0.0:
            continue
        patterns = [slowest, *regular_patterns(loop)]
        gain = float(np.max(pattern_gains(loop, patterns)))
        proof = certify_decay(loop, patterns, gain)
        if proof is None or proof.figure <= 0.0:
            continue
        reached = worst_peak(loop)
        bound = certify_peak(loop, patterns, gain, proof.figure, reached)
        assert bound is not None
        periods = 6 if loop.network.losses_max else 9
        brute = max(brute_force(loop, periods, float(phase)) for phase in (1.0, draw.uniform()))
        return bound.certified, max(reached, bound.reached), brute
