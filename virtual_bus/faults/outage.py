"""Base of outages of the host's own CAN adapter, and of its kernel."""

from typing import ClassVar

from servobench.virtual_bus.faults.fault_table import Lasting, ns
from servobench.virtual_bus.faults.node_fault import Draw, Occasion


class AdapterOutage(Occasion):
    """For a while the host's adapter takes no frames, or gives none."""

    code: ClassVar[int | None] = None
    """Error code for a sender, from errno; None: it takes frames."""
    hears: ClassVar[bool] = True
    """True if it continues to receive."""
    begins: ClassVar[str] = ""
    """Message at the begin; empty: none."""
    ends: ClassVar[str] = ""
    """The same when it ends; ``{unheard}``: how many frames came meanwhile."""
    duration_s: Lasting

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return (ns(self.duration_s),)
