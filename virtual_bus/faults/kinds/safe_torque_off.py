"""``[[safe_torque_off]]``: somebody opens the safety door of a drive."""

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.faults.fault_table import Lasting, LogNumber, node_event, ns
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode


class SafeTorqueOff(NodeOccasion):
    """The drive's STO input is open for a while: no torque at once, no fault, and voltage enabled goes."""

    kind = "safe_torque_off"
    logs = (node_event("safe_torque_off", LogNumber("duration_ns")),)
    needs_drive = True
    strikes_plant = True
    duration_s: Lasting

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return (ns(self.duration_s),)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        node.open_sto(True, now)
        node.later(now + event.a, lambda at: node.open_sto(False, at))
