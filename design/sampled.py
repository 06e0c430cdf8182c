"""What can be said of the loop that really runs: decay, gain, and a certificate for every sequence.

Two kinds of statement, kept apart: what holds under a stated periodic pattern (exact), and what holds
under every admissible sequence of losses and delays (certified). A pattern found by search bounds from
the other side what any certificate can reach.
"""

from dataclasses import dataclass

import numpy as np

from design.delay_loop import Array
from design.errors import NoSolution
from design.held_loop import Delivery, HeldLoop, SampledNetwork, Strategy
from design.lifting import sampled_gain
from design.loss_patterns import Pattern, chain_of, repeated, worst_pattern
from design.sequence_certificate import SequenceCertificate, certify
from design.speed_loop import SpeedModel


@dataclass(frozen=True, slots=True, eq=False)
class SampledAnalysis:
    """The figures of one sampled loop."""

    network: SampledNetwork
    regular: list[Pattern]
    """Under d lost of every d + 1, all others delayed by T: for each d from 0 to D."""
    gains: list[float]
    """Gain from load torque to speed error under each of them, rad/s per N m; inf where unstable."""
    worst: Pattern
    """The periodic pattern of least decay that the search found."""
    certificate: SequenceCertificate | None
    """None: not even stability could be certified for every sequence."""
    without_certificate: str = ""
    """Why there is none, if that is so."""

    @property
    def decay_per_s(self) -> float:
        """Least decay of the regular patterns, 1/s; negative: unstable."""
        return min(pattern.decay_per_s for pattern in self.regular)

    @property
    def gain(self) -> float:
        """Largest gain of the regular patterns, rad/s per N m."""
        return max(self.gains)

    @property
    def certified(self) -> bool:
        """Whether the loop is proved to be stable under every admissible sequence."""
        return self.certificate is not None and self.certificate.decay_per_s > 0.0

    @property
    def refuted(self) -> bool:
        """Whether an admissible pattern is known that makes the loop unstable."""
        return self.worst.decay_per_s <= 0.0


def analyse_sampled(model: SpeedModel, K: Array, network: SampledNetwork) -> SampledAnalysis:
    """Everything of :class:`SampledAnalysis`. Raises NoSolution if a norm cannot be shown to be one."""
    loop = HeldLoop(model, np.asarray(K, dtype=float), network)
    regular = regular_patterns(loop)
    gains = [sampled_gain(loop, chain_of(loop, pattern)) for pattern in regular]
    worst = min([worst_pattern(loop), *regular], key=lambda pattern: pattern.decay_per_s)
    certificate, why = None, "no quadratic functions were found that fall along every sequence"
    if worst.decay_per_s <= 0.0:
        return SampledAnalysis(
            network, regular, gains, worst, None, "a pattern is known that destabilises it"
        )
    try:
        certificate = certify(loop, worst.decay_per_s)
    except NoSolution as error:
        why = str(error)
    return SampledAnalysis(
        network, regular, gains, worst, certificate, "" if certificate is not None else why
    )


def regular_patterns(loop: HeldLoop) -> list[Pattern]:
    """d lost of every d + 1 for d = 0 .. D, each delay T; with history losses make no difference."""
    network = loop.network
    most = 0 if network.strategy is Strategy.HISTORY else network.losses_max
    return [repeated(loop, (Delivery(d + 1, network.delay_max_s),)) for d in range(most + 1)]
