"""``[[refused_mapping]]``: a drive that does not take a PDO mapping."""

from typing import Annotated, Final

from pydantic import model_validator

from servobench.drivers.canopen.objects301 import PDO_ENTRIES_MAX, is_mapping
from servobench.drivers.errors import MISSING
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.faults.fault_table import NONE, LogNumber, node_event, require, within
from servobench.virtual_bus.faults.mapped_objects import ObjectPlace, place_of, place_text
from servobench.virtual_bus.faults.node_fault import NodeEvent, NodeFault, StruckNode

NOT_MAPPABLE: Final = 0x06040041
"""Object cannot be mapped to the PDO (CiA 301, table 22)."""
AbortNumber = Annotated[
    int, within(0x05000000, 0x0FFFFFFF, "an SDO abort code, such as 0x06040041 (CiA 301, table 22)")
]


class RefusedMapping(NodeFault):
    """Writes of a mapping parameter are refused, from power-on: of ``parameter``, such as 1A00h:1, or of all
    entries of all PDOs; with ``mapped`` only those that would map that object.

    A drive with a mapping of its own that stays refuses sub-index 0.
    """

    kind = "refused_mapping"
    logs = (
        node_event(
            "refused_mapping",
            LogNumber("abort"),
            LogNumber("parameter", usual=0),
            LogNumber("mapped", usual=0),
            since_power_on=True,
        ),
    )
    parameter: ObjectPlace | None = None
    mapped: ObjectPlace | None = None
    abort: AbortNumber = NOT_MAPPABLE

    @model_validator(mode="after")
    def _check_places(self) -> "RefusedMapping":
        both = self.parameter is not None or self.mapped is not None
        require(both, "parameter", MISSING, 'a mapping parameter, such as "1A00:1", or mapped, or both')
        if self.parameter is not None:
            place = place_of(self.parameter)
            good = is_mapping(place >> 8) and place & 0xFF <= PDO_ENTRIES_MAX
            expected = f"1600h to 17FFh or 1A00h to 1BFFh, sub-index 0 to {PDO_ENTRIES_MAX}"
            require(good, "parameter", self.parameter, expected)
            counts = self.mapped is not None and not place & 0xFF
            require(
                not counts, "mapped", self.mapped, f"nothing beside parameter = {self.parameter!r}, a count"
            )
        return self

    def from_power_on(self) -> NodeEvent:
        parameter, mapped = (0 if text is None else place_of(text) for text in (self.parameter, self.mapped))
        return NodeEvent(0, self.kind, self.abort, parameter, mapped)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:  # noqa: ARG004
        node.refuse_mapping(event.b >> 8, event.b & 0xFF, event.a, event.c)

    @staticmethod
    def lasts_ns(event: NodeEvent) -> int:  # noqa: ARG004
        return NONE

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        where = f"{place_text(event.b)} is refused" if event.b else "a mapping is refused"
        what = f" for {place_text(event.c)}" if event.c else ""
        return f"{where}{what} with {event.a:08X}h, {node}"
