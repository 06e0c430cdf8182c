"""``[[slow_drive]]``: a drive that takes its time."""

from typing import Final

from pydantic import model_validator

from servobench.drivers.errors import MISSING
from servobench.drivers.timebase import NS_PER_S
from servobench.virtual_bus.faults.fault_table import LATER, LogKind, Number, RangeRule, require
from servobench.virtual_bus.faults.frame_fault import COB_IDS
from servobench.virtual_bus.faults.node_fault import NodeFault, Slowness, Streams

BOOT_MAX: Final = 600 * NS_PER_S
"""No drive takes so long; beyond it stands a mistaken unit."""


class SlowDrive(NodeFault):
    """A drive that takes its time from power-on: for SDO answers, for its PDOs, to boot after any reset.

    Frames of each of the two classes keep their order. While it boots, it hears and sends nothing.
    """

    kind = "slow_drive"
    logs = (
        LogKind("late", (LATER,), "node", since_power_on=True),
        LogKind("boot", (LATER,), "node", "count", since_power_on=True),
    )
    ranges = (
        RangeRule("sdo_delay_us", optional=True),
        RangeRule("tpdo_delay_us", optional=True),
        RangeRule("boot_s", high=BOOT_MAX, optional=True),
    )
    sdo_delay_us: Number | None = None
    sdo_delay_min_us: Number | None = None
    sdo_delay_max_us: Number | None = None
    tpdo_delay_us: Number | None = None
    tpdo_delay_min_us: Number | None = None
    tpdo_delay_max_us: Number | None = None
    boot_s: Number | None = None
    boot_min_s: Number | None = None
    boot_max_s: Number | None = None

    @model_validator(mode="after")
    def _check_times(self) -> "SlowDrive":
        expected = "sdo_delay_us, tpdo_delay_us or boot_s, or a _min and _max of it"
        some = any(self.range(rule.key).max_ns > 0 for rule in self.ranges)
        require(some, "sdo_delay_us", MISSING, expected)
        return self

    def slowness(self, streams: Streams) -> Slowness:
        return _Slow(self, streams)


class _Slow:
    """One drive's, with a random stream for each of its parts."""

    def __init__(self, fault: SlowDrive, streams: Streams) -> None:
        self._parts = [
            (COB_IDS[frames], fault.range(key), streams(f"/{name}"))
            for frames, key, name in (("sdo", "sdo_delay_us", "sdo"), ("pdo", "tpdo_delay_us", "tpdo"))
        ]
        self._boot = fault.range("boot_s")
        self._draw_boot = streams("/boot")

    def lateness(self, can_id: int) -> int:
        return sum(part.drawn(draw) for frames, part, draw in self._parts if can_id in frames)

    def boot_time(self) -> int:
        return self._boot.drawn(self._draw_boot)
