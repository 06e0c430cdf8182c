"""What the outages of the host's own CAN adapter have in common."""

from typing import ClassVar

from virtual_bus.faults.fault_table import Lasting, ns
from virtual_bus.faults.node_fault import Draw, Occasion


class AdapterOutage(Occasion):
    """For a while the host's adapter does not take frames, or does nothing at all."""

    code: ClassVar[int]
    """What a sender is told, from errno."""
    hears: ClassVar[bool]
    """Whether it goes on receiving."""
    duration_s: Lasting

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return (ns(self.duration_s),)
