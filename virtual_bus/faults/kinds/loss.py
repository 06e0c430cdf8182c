"""``[[loss]]``: each frame by itself."""

from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import LogKind, Probability
from servobench.virtual_bus.faults.frame_fault import FrameFault, IndependentStrike, Strike


class Loss(FrameFault):
    """Each frame is lost with the same probability, whatever happened to the others."""

    kind = "loss"
    logs = (LogKind("loss"),)
    probability: Probability

    def at_work(self, stream: UniformStream) -> Strike:
        return IndependentStrike(self.kind, self.window, self.probability, stream)
