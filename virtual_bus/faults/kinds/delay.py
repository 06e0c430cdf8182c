"""``[[delay]]``: frames are held, fixed or drawn evenly."""

from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import LATER, LogKind, LogNumber, Number, RangeRule
from servobench.virtual_bus.faults.frame_fault import FrameFault, Hold, UniformHold


class Delay(FrameFault):
    """A frame is held for a time drawn evenly.

    Frames of one link (one direction, one node) keep their order, which may hold one
    longer, unless ``reorder``. Several delays of a frame add up.
    """

    kind = "delay"
    logs = (LogKind("delay", (LATER, LogNumber("in_order", words=(False, True), usual=1))),)
    ranges = (RangeRule("delay_us", "delay"),)
    delays = True
    delay_us: Number | None = None
    delay_min_us: Number | None = None
    delay_max_us: Number | None = None
    reorder: bool = False

    def at_work(self, stream: UniformStream) -> Hold:
        delay = self.range("delay_us")
        return UniformHold(self.window, not self.reorder, delay.min_ns, delay.width, stream)
