"""Disturbances on the wire, as a bystander sees them."""

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.frame import Frame


class Disturbance(NamedTuple):
    """One wrong bit of one attempt to send a frame."""

    bit: int
    """Its place on the wire: 0 is the start of frame, stuff bits count; beyond the frame: its last bit."""
    receivers: tuple[str, ...] | None = None
    """Names of the receiving ports that alone see the inverse level; None: every node, the sender too."""


Disturb = Callable[[str, Frame, Instant], Disturbance | None]
"""(name of the sending port, frame, start of frame) -> what disturbs this attempt; None: nothing."""


class ErrorKind(Enum):
    """The error detected first (Bosch CAN 2.0, part B, 7.1)."""

    BIT = "bit error"
    STUFF = "stuff error"
    CRC = "CRC error"
    FORM = "form error"
    ACKNOWLEDGEMENT = "acknowledgement error"
    CUT_OFF = "sender left the bus"


class BusError(NamedTuple):
    """An attempt that failed; seen at the end of the error delimiter."""

    at: Instant
    """End of the error delimiter."""
    kind: ErrorKind
    sender: str
    """Name of the port whose frame it was."""
    frame: Frame
    bit: int
    """Place on the wire where the error was detected first."""
    bits: int
    """Bits from the start of frame to the end of the error delimiter."""


OnError = Callable[[BusError], None]
