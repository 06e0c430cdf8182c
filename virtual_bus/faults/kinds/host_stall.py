"""``[[host_stall]]``: a host that is late."""

from servobench.virtual_bus.faults.fault_table import LogKind, LogNumber, Number, RangeRule
from servobench.virtual_bus.faults.node_fault import Draw, Occasion


class HostStall(Occasion):
    """The host's next action is late, by a time drawn evenly.

    It strikes the first action at or after its instant. Of several strikes of one table since the last action
    the longest counts; those of several tables add up.
    """

    kind = "host_stall"
    logs = (LogKind("host_stall", (LogNumber("late_ns"),), "host", "count"),)
    ranges = (RangeRule("late_us"),)
    late_us: Number | None = None
    late_min_us: Number | None = None
    late_max_us: Number | None = None

    def numbers(self, draw: Draw) -> tuple[int, ...]:
        return (self.range("late_us").drawn(draw),)
