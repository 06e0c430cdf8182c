"""A frame as a log has it."""

from typing import Final, NamedTuple

CLASSICAL_BYTES_MAX: Final = 8
FD_BYTES_MAX: Final = 64


class LogFrame(NamedTuple):
    """One frame of a log or of a live bus."""

    number: int
    """Line or packet of the log, from 1 on."""
    at_ns: int | None
    """Time as the log counts; None where it has no times."""
    channel: str
    """Name of the interface; empty if the log does not tell it."""
    can_id: int
    """11 or 29 bits, without flags; of an error frame its class bits (linux/can/error.h)."""
    data: bytes
    extended: bool = False
    remote: bool = False
    error: bool = False
    fd: bool = False
    sent: str = ""
    """T: sent by who wrote the log, R: received by it; empty if it does not tell."""
