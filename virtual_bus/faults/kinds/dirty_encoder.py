"""``[[dirty_encoder]]``: the encoder of a motor sees no edges where its disc is dirty, for a while."""

from typing import Annotated, Final

from pydantic import model_validator

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.faults.fault_table import Lasting, LogNumber, node_event, ns, require, within
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode

_MDEG_PER_TURN: Final = 360_000
Degrees = Annotated[float, within(0.0, 360.0, "0 to 360 degrees of the shaft")]


class DirtyEncoder(NodeOccasion):
    """An incremental encoder's count stands still from ``from_deg`` to ``to_deg`` of each turn: these counts
    are lost, and with them the angle by which the drive commutates."""

    kind = "dirty_encoder"
    logs = (
        node_event("dirty_encoder", LogNumber("duration_ns"), LogNumber("from_mdeg"), LogNumber("to_mdeg")),
    )
    needs_drive = True
    strikes_plant = True
    from_deg: Degrees
    to_deg: Degrees
    duration_s: Lasting

    @model_validator(mode="after")
    def _check_way(self) -> "DirtyEncoder":
        require(self.to_deg > self.from_deg, "to_deg", self.to_deg, f"more than from_deg = {self.from_deg:g}")
        return self

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return ns(self.duration_s), round(1000 * self.from_deg), round(1000 * self.to_deg)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        ends = event.b / _MDEG_PER_TURN, event.c / _MDEG_PER_TURN
        node.damage(lambda drive: drive.soil_encoder(*ends), now)
        node.later(now + event.a, lambda at: node.damage(lambda drive: drive.soil_encoder(0.0, 0.0), at))

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        place = f"{event.b / 1000:g} to {event.c / 1000:g} degrees"
        return f"encoder dirty from {place} for {event.a / NS_PER_MS:g} ms, {node}"
