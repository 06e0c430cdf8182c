"""``[[reorder]]``: frames that others overtake."""

from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import (
    LATER,
    UNDAMAGED,
    Copies,
    LogKind,
    LogNumber,
    Number,
    Probability,
    RangeRule,
)
from servobench.virtual_bus.faults.frame_fault import FrameFault, NumberedStrike, Strike


def _held_back(held_ns: int) -> Copies:
    return ((UNDAMAGED, held_ns),)


class Reorder(FrameFault):
    """A frame is held back outside of its link's order, so that those behind it overtake it."""

    kind = "reorder"
    logs = (LogKind("reorder", (LogNumber("held_ns"), LATER), copies=_held_back, in_order=False),)
    ranges = (RangeRule("held_us", low=1),)
    rank = 3
    probability: Probability
    held_us: Number | None = None
    held_min_us: Number | None = None
    held_max_us: Number | None = None

    def at_work(self, stream: UniformStream) -> Strike:
        held = self.range("held_us")
        return NumberedStrike(self.kind, self.window, self.probability, held.min_ns, held.width, stream)
