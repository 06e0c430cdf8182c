"""``[[clock_step]]``: a drive's clock that jumps."""

from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Instant
from servobench.virtual_bus.faults.fault_table import LogNumber, Number, RangeRule, node_event
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode

STEP_MAX = 3600 * NS_PER_S
"""1013h wraps after 71.6 minutes: a step of more would look like a smaller one."""


class ClockStep(NodeOccasion):
    """The drive's clock jumps by an amount drawn evenly; negative: back."""

    kind = "clock_step"
    logs = (node_event("clock_step", LogNumber("step_ns", least=-(2**62))),)
    ranges = (RangeRule("step_us", "step", -STEP_MAX, STEP_MAX),)
    step_us: Number | None = None
    step_min_us: Number | None = None
    step_max_us: Number | None = None

    def numbers(self, draw: Draw) -> tuple[int, ...]:
        return (self.range("step_us").drawn(draw),)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:  # noqa: ARG004
        node.step_clock(event.a)

    @staticmethod
    def lasts_ns(event: NodeEvent) -> int:  # noqa: ARG004
        return 0

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        return f"clock step of {event.a / NS_PER_US:g} us, {node}"
