"""``[[duplicate]]``: frames that come twice."""

from typing import Annotated

from servobench.drivers.timebase import NS_PER_US
from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import (
    DELAY_MAX,
    LATER,
    UNDAMAGED,
    Copies,
    LogKind,
    LogNumber,
    Probability,
    ns,
    within,
)
from servobench.virtual_bus.faults.frame_fault import FrameFault, NumberedStrike, Strike

_MOST_US = DELAY_MAX // NS_PER_US


def _twice(later_ns: int) -> Copies:
    return (UNDAMAGED, 0), (UNDAMAGED, later_ns)


class Duplicate(FrameFault):
    """A frame comes twice: the second one ``later_us`` after the first, outside of the link's order."""

    kind = "duplicate"
    logs = (LogKind("duplicate", (LogNumber("later_ns"), LATER), copies=_twice),)
    rank = 2
    probability: Probability
    later_us: Annotated[float, within(0, _MOST_US, f"a time from 0 to {_MOST_US} us")] = 0.0

    def at_work(self, stream: UniformStream) -> Strike:
        later_ns = ns(self.later_us, "us")
        return NumberedStrike(self.kind, self.window, self.probability, later_ns, 0, stream)
