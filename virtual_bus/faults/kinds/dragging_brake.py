"""``[[dragging_brake]]``: the holding brake of a motor does not let go wholly for a while."""

from typing import Annotated, Final

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.faults.fault_table import Lasting, LogNumber, node_event, ns, within
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode

_UNM_PER_NM: Final = 1e6


class DraggingBrake(NodeOccasion):
    """The brake rubs with ``torque_nm`` on the rotor, whichever way it turns, and holds it at rest."""

    kind = "dragging_brake"
    logs = (node_event("dragging_brake", LogNumber("duration_ns"), LogNumber("torque_unm")),)
    needs_drive = True
    strikes_plant = True
    torque_nm: Annotated[float, within(1e-6, 1e6, "more than 0 N m, at most 1e6")]
    duration_s: Lasting

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return ns(self.duration_s), round(self.torque_nm * _UNM_PER_NM)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        torque_nm = event.b / _UNM_PER_NM
        node.damage(lambda drive: drive.drag_brake(torque_nm), now)
        node.later(now + event.a, lambda at: node.damage(lambda drive: drive.drag_brake(0.0), at))

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        return f"brake drags with {event.b / _UNM_PER_NM:g} N m for {event.a / NS_PER_MS:g} ms, {node}"
