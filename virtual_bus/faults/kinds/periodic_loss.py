"""``[[periodic_loss]]``: so many of each so many and one."""

from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import Count, LogKind
from servobench.virtual_bus.faults.frame_fault import FrameFault, PeriodicStrike, Strike


class PeriodicLoss(FrameFault):
    """Passes the first of every ``lost`` + 1 frames of a COB-ID and loses the others."""

    kind = "periodic_loss"
    logs = (LogKind("periodic_loss"),)
    of_each_cob_id = True
    lost: Count

    def at_work(self, stream: UniformStream) -> Strike:  # noqa: ARG002
        return PeriodicStrike(self.kind, self.window, self.lost)
