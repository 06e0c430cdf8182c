"""``[[burst]]``: losses that come together."""

from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import LogKind, Probability
from servobench.virtual_bus.faults.frame_fault import BurstStrike, FrameFault, Strike


class Burst(FrameFault):
    """Losses in bursts: the chain of Gilbert (1960) and Elliott (1963) with two states.

    Each frame of a link first moves the chain (which begins good), then is lost with the
    probability of the state reached. With ``loss_bad`` 1 and ``loss_good`` 0 a burst has a
    geometric length of mean 1 / p_bad_to_good frames, and in the long run
    p_good_to_bad / (p_good_to_bad + p_bad_to_good) of the frames are lost.
    """

    kind = "burst"
    logs = (LogKind("burst"),)
    p_good_to_bad: Probability
    p_bad_to_good: Probability
    loss_bad: Probability = 1.0
    loss_good: Probability = 0.0

    def at_work(self, stream: UniformStream) -> Strike:
        moves = self.p_good_to_bad, self.p_bad_to_good
        return BurstStrike(self.kind, self.window, moves, (self.loss_good, self.loss_bad), stream)
