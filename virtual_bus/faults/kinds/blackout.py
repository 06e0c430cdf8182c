"""``[[blackout]]``: nothing comes through for a time, or for so many frames."""

from pydantic import model_validator

from servobench.drivers.errors import MISSING
from servobench.drivers.timebase import NEVER, Duration
from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import Count, Lasting, LogKind, ns, require
from servobench.virtual_bus.faults.frame_fault import FirstStrikes, FrameFault, Strike


class Blackout(FrameFault):
    """Every frame is lost: throughout the window, or the first ``count`` of each COB-ID in it.

    It needs one end of the two.
    """

    kind = "blackout"
    logs = (LogKind("blackout"),)
    of_each_cob_id = True
    duration_s: Lasting | None = None
    """Instead of ``until_s``."""
    count: Count | None = None

    @model_validator(mode="after")
    def _check_end(self) -> "Blackout":
        if self.duration_s is not None:
            require(self.until_s is None, "until_s", self.until_s, "nothing beside duration_s")
        ends = self.count is not None or self.until_ns is not None
        require(ends, "duration_s", MISSING, "a duration, or until_s, or count: a blackout has an end")
        return self

    @property
    def until_ns(self) -> Duration | None:
        """Exclusive; None: to the end."""
        return super().until_ns if self.duration_s is None else ns(self.from_s + self.duration_s)

    def at_work(self, stream: UniformStream) -> Strike:  # noqa: ARG002
        return FirstStrikes(self.kind, self.window, NEVER if self.count is None else self.count)
