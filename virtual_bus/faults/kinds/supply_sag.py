"""``[[supply_sag]]``: what feeds a drive gives less for a while."""

from typing import Annotated, Final

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.faults.fault_table import Lasting, LogNumber, node_event, ns, within
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode

_PERMILLE: Final = 1000
Share = Annotated[float, within(0.0, 100.0, "0 to 100 per cent")]


class SupplySag(NodeOccasion):
    """The voltage of the source falls to ``to_percent``, and returns after ``duration_s``.

    The DC link of a drive with a capacitor (``[supply]`` of its file) empties by what the motor takes; any
    other follows at once.
    """

    kind = "supply_sag"
    logs = (node_event("supply_sag", LogNumber("duration_ns"), LogNumber("permille")),)
    needs_drive = True
    strikes_plant = True
    to_percent: Share
    duration_s: Lasting

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return ns(self.duration_s), round(10 * self.to_percent)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        node.scale_supply(event.b / _PERMILLE, now)
        node.later(now + event.a, lambda at: node.scale_supply(1.0, at))

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        return f"supply at {event.b / 10:g} % for {event.a / NS_PER_MS:g} ms, {node}"
