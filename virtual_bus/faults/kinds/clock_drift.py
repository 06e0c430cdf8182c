"""``[[clock_drift]]``: a drive's clock that runs faster for a time."""

from collections.abc import Iterator
from typing import Annotated

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.faults.fault_table import NONE, LogNumber, TimeWindow, node_event, within
from servobench.virtual_bus.faults.node_fault import NodeEvent, NodeFault, Streams, StruckNode

DRIFT_PPM_MAX = 10_000
"""1 %, as of an oscillator without a crystal; those with one stay within 100 ppm."""


class ClockDrift(TimeWindow, NodeFault):
    """The drive's clock runs faster by ``drift_ppm`` within a window, on top of its own drift."""

    kind = "clock_drift"
    logs = (node_event("clock_drift", LogNumber("drift_ppb", least=-(2**62))),)
    drift_ppm: Annotated[
        float, within(-DRIFT_PPM_MAX, DRIFT_PPM_MAX, f"from -{DRIFT_PPM_MAX} to {DRIFT_PPM_MAX}")
    ]

    def events(self, streams: Streams) -> Iterator[NodeEvent]:  # noqa: ARG002
        drift_ppb = round(self.drift_ppm * 1000)
        yield NodeEvent(self.from_ns, self.kind, drift_ppb)
        if self.until_ns is not None:
            yield NodeEvent(self.until_ns, self.kind, -drift_ppb)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        node.drift_clock(event.a, now)

    @staticmethod
    def lasts_ns(event: NodeEvent) -> int:  # noqa: ARG004
        return NONE

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        return f"clock drift of {event.a / 1000:g} ppm more, {node}"
