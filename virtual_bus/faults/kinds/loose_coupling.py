"""``[[loose_coupling]]``: the coupling behind a motor gives way for a while."""

from typing import Annotated, Final

from pydantic import model_validator

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.faults.fault_table import Lasting, LogNumber, node_event, ns, require, within
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode

_WHOLE: Final = 100.0
"""Per cent."""
_PERMILLE: Final = 1000
_NRAD_PER_RAD: Final = 1e9


class LooseCoupling(NodeOccasion):
    """The coupling has ``stiffness_percent`` of its stiffness left, and ``backlash_rad`` more play: a hub
    that slips, a belt that has lost its tension."""

    kind = "loose_coupling"
    logs = (
        node_event(
            "loose_coupling",
            LogNumber("duration_ns"),
            LogNumber("stiffness_permille"),
            LogNumber("backlash_nrad"),
        ),
    )
    needs_drive = True
    strikes_plant = True
    needs_part = "coupling"
    stiffness_percent: Annotated[float, within(1.0, 100.0, "1 to 100 per cent")] = _WHOLE
    backlash_rad: Annotated[float, within(0.0, 1.0, "0 to 1 rad")] = 0.0
    duration_s: Lasting

    @model_validator(mode="after")
    def _check_loose(self) -> "LooseCoupling":
        loose = self.stiffness_percent < _WHOLE or self.backlash_rad > 0.0
        require(loose, "stiffness_percent", self.stiffness_percent, "less than 100, or a backlash_rad")
        return self

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        share, play = round(10 * self.stiffness_percent), round(self.backlash_rad * _NRAD_PER_RAD)
        return ns(self.duration_s), share, play

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        share, backlash_rad = event.b / _PERMILLE, event.c / _NRAD_PER_RAD
        node.damage(lambda drive: drive.loosen_coupling(share, backlash_rad), now)
        node.later(now + event.a, lambda at: node.damage(lambda drive: drive.loosen_coupling(1.0, 0.0), at))

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        stiffness = f"coupling of {event.b / 10:g} % stiffness"
        play = f" and {event.c / _NRAD_PER_RAD:g} rad more play" if event.c else ""
        return f"{stiffness}{play} for {event.a / NS_PER_MS:g} ms, {node}"
