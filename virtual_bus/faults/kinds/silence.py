"""``[[silence]]``: a node whose plug is pulled."""

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.faults.fault_table import Lasting, LogNumber, node_event, ns
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode


class Silence(NodeOccasion):
    """The node neither hears nor sends, as with its plug pulled; it goes on by itself."""

    kind = "silence"
    logs = (node_event("silence", LogNumber("duration_ns")),)
    duration_s: Lasting

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return (ns(self.duration_s),)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        node.silence(now + event.a)
