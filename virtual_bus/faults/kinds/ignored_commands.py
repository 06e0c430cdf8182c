"""``[[ignored_commands]]``: a drive that is enabled and does not follow its set-points."""

from typing import Final, Literal

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.faults.fault_table import NONE, Lasting, LogNumber, node_event, ns
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode

_HOLDS: Final = ("last", "zero")


class IgnoredCommands(NodeOccasion):
    """Set-points arrive, stand in their objects, and are not followed; the state machine goes on to obey.

    ``holds``: what the drive follows instead, its last set-points, or none: no torque, no speed, the position
    that it has. ``bit_12_cleared``: the statusword says so (CiA 402-2: bit 12 = 0 in a cyclic mode, target
    ignored); false: nothing does. ``duration_s`` left out: for good, until a reset of the node.
    """

    kind = "ignored_commands"
    logs = (
        node_event(
            "ignored_commands",
            LogNumber("holds", words=_HOLDS),
            LogNumber("bit_12_cleared", words=(False, True)),
            LogNumber("duration_ns", usual=NONE),
        ),
    )
    needs_drive = True
    holds: Literal["last", "zero"] = "last"
    bit_12_cleared: bool = True
    duration_s: Lasting | None = None

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        lasts_ns = NONE if self.duration_s is None else ns(self.duration_s)
        return _HOLDS.index(self.holds), int(self.bit_12_cleared), lasts_ns

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        node.turn_deaf(_HOLDS[event.a] == "zero", event.b != 0, now)
        if event.c != NONE:
            node.later(now + event.c, node.hear_again)

    @staticmethod
    def lasts_ns(event: NodeEvent) -> int:
        return event.c

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        lasts = "" if event.c == NONE else f" for {event.c / NS_PER_MS:g} ms"
        told = "cleared" if event.b else "as if they were followed"
        held = "the last ones" if _HOLDS[event.a] == "last" else "none"
        return f"set-points ignored, {node}{lasts}: it follows {held}, bit 12 {told}"
