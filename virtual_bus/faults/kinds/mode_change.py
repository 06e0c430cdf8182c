"""``[[mode_change]]``: a drive that takes another mode of operation by itself."""

from typing import Final, Literal

from servobench.drivers.cia402.profile import Mode
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.faults.fault_table import NONE, Lasting, LogNumber, node_event, ns
from servobench.virtual_bus.faults.node_fault import Draw, NodeEvent, NodeOccasion, StruckNode

MODES: Final = {
    "pp": Mode.PROFILE_POSITION,
    "vl": Mode.VELOCITY,
    "pv": Mode.PROFILE_VELOCITY,
    "pt": Mode.PROFILE_TORQUE,
    "hm": Mode.HOMING,
    "ip": Mode.INTERPOLATED_POSITION,
    "csp": Mode.CYCLIC_SYNCHRONOUS_POSITION,
    "csv": Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
    "cst": Mode.CYCLIC_SYNCHRONOUS_TORQUE,
}
"""By the abbreviations of CiA 402-2: the modes that a simulated drive has."""
_WORDS: Final = tuple(MODES)


class ModeChange(NodeOccasion):
    """The drive is in another mode than 6060h says, as after a tool of its maker's or a key at the drive has
    changed it: 6061h tells so, and the drive behaves so, by the set-points of that mode.

    After ``duration_s`` it goes back to the mode of 6060h; left out: it stays. Another mode written to 6060h
    is taken at any time.
    """

    kind = "mode_change"
    logs = (node_event("mode_change", LogNumber("mode", words=_WORDS), LogNumber("duration_ns", usual=NONE)),)
    needs_drive = True
    mode: Literal["pp", "vl", "pv", "pt", "hm", "ip", "csp", "csv", "cst"]
    duration_s: Lasting | None = None

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return _WORDS.index(self.mode), NONE if self.duration_s is None else ns(self.duration_s)

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        mode = MODES[_WORDS[event.a]]
        node.take_mode(mode, now)
        if event.b != NONE:
            node.later(now + event.b, lambda at: node.leave_mode(mode, at))

    @staticmethod
    def lasts_ns(event: NodeEvent) -> int:
        return event.b

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:  # noqa: ARG004
        lasts = "" if event.b == NONE else f" for {event.b / NS_PER_MS:g} ms"
        return f"change of mode to {MODES[_WORDS[event.a]].title}, {node}{lasts}"
