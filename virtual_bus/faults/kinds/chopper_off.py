"""``[[chopper_off]]``: the braking resistor of a drive takes nothing for a while."""

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.faults.fault_table import Lasting, LogNumber, node_event, ns
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode


class ChopperOff(NodeOccasion):
    """The line to the braking resistor is broken: what braking returns charges the DC link."""

    kind = "chopper_off"
    logs = (node_event("chopper_off", LogNumber("duration_ns")),)
    needs_drive = True
    strikes_plant = True
    needs_part = "supply.chopper"
    duration_s: Lasting

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return (ns(self.duration_s),)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        node.damage(lambda drive: drive.open_chopper(True), now)
        node.later(now + event.a, lambda at: node.damage(lambda drive: drive.open_chopper(False), at))
