"""``[[bus_off]]``: a node whose CAN controller goes bus-off."""

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.faults.fault_table import NONE, Lasting, LogNumber, node_event, ns
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode


class BusOff(NodeOccasion):
    """The node's CAN controller goes bus-off; 1029h and 6007h of the node act.

    After ``recover_after_s`` its controller begins to recover, which takes 128 times 11 recessive bits
    on a bus with error counters and no time elsewhere; None: never.
    """

    kind = "bus_off"
    logs = (node_event("bus_off", LogNumber("recover_after_ns", optional=True)),)
    recover_after_s: Lasting | None = None

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return (NONE if self.recover_after_s is None else ns(self.recover_after_s),)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        node.go_bus_off(now, None if event.a == NONE else event.a)

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        back = "" if event.a == NONE else f", it recovers after {event.a / NS_PER_MS:g} ms"
        return f"bus off, {node}{back}"
