"""``[[corruption]]``: frames that are damaged under way."""

from typing import Final, Literal

from pydantic import model_validator

from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import (
    LATER,
    NONE,
    Copies,
    LogKind,
    LogNumber,
    Probability,
    require,
)
from servobench.virtual_bus.faults.frame_fault import FrameFault, NumberedStrike

ERROR_FRAME: Final = "error_frame"
"""An effect, and the kind of its entries in the log: ``n`` is of attempts to send, ``bit`` on the wire."""
BIT_DRAWS: Final = 8 * 840
"""A multiple of the data bits of every length, 8, 16 .. 64: each bit is drawn as often as the others."""


def _damaged(bit: int) -> Copies:
    return ((bit, 0),)


class Corruption(FrameFault):
    """A frame is damaged under way.

    ``error_frame``: a bit is disturbed on the wire. Every node sees it, the sender repeats the frame
    (ISO 11898-1), and each attempt is struck anew. Only a simulated segment can do this; through any other
    bus the frame is lost.
    ``lost``: the receiver throws the frame away: its check sequence does not fit, and nobody repeats it.
    ``data``: one bit of the data is inverted and nobody notices; a frame without data passes.
    """

    kind = "corruption"
    logs = (
        LogKind("corruption", (LogNumber("bit", optional=True), LATER), copies=_damaged),
        LogKind(ERROR_FRAME, (LogNumber("bit"),)),
    )
    rank = 1
    probability: Probability
    effect: Literal["error_frame", "lost", "data"] = "error_frame"

    @model_validator(mode="after")
    def _check_side(self) -> "Corruption":
        seen_by_all = '"lost" or "data": an error frame is seen by every node, whatever the side'
        require(not (self.on_the_wire and self.side == "drive"), "effect", self.effect, seen_by_all)
        return self

    @property
    def on_the_wire(self) -> bool:
        """See :class:`FrameFault`."""
        return self.effect == ERROR_FRAME

    def at_work(self, stream: UniformStream) -> NumberedStrike:
        least, width = (0, BIT_DRAWS) if self.effect == "data" else (NONE, 0)
        return NumberedStrike(self.kind, self.window, self.probability, least, width, stream)
