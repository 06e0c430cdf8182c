"""``[[lss_yes_sayer]]``: a node that answers where CiA 305 has it silent."""

from collections.abc import Iterator

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.faults.fault_table import NONE, node_event
from servobench.virtual_bus.faults.node_fault import NodeEvent, NodeFault, Streams, StruckNode


class LssYesSayer(NodeFault):
    """Every frame of an LSS fast scan is answered in the configuration state, whatever it asks.

    CANopenNode's slave does so; by CiA 305 fast scan is a service of the waiting state.
    """

    kind = "lss_yes_sayer"
    logs = (node_event("lss_yes_sayer"),)

    def events(self, streams: Streams) -> Iterator[NodeEvent]:  # noqa: ARG002
        yield NodeEvent(0, self.kind, 0)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:  # noqa: ARG004
        node.answer_scan_in_configuration()

    @staticmethod
    def lasts_ns(event: NodeEvent) -> int:  # noqa: ARG004
        return NONE

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        return f"fast scan is answered in the LSS configuration state, {node}"
