"""The lean path of a bus: frames as plain tuples, with stamps that are on the bench's axis already.

A bus may offer it beside python-can's ``recv`` and ``send``.
"""

from typing import NamedTuple, Protocol, runtime_checkable

from drivers.timebase import Instant


class WireFrame(NamedTuple):
    """A classical CAN frame on the lean path; the fields in this order are all that the path relies on."""

    can_id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    remote_length: int = 0


@runtime_checkable
class LeanBus(Protocol):
    """The lean path of a bus."""

    def recv_frame(self, until: Instant) -> tuple[tuple[int, bytes, bool, bool, int], Instant] | None:
        """The next frame and its stamp on the bench's axis; None once ``until`` has come."""
        ...

    def send_frame(self, frame: WireFrame) -> None:
        """Queue a frame for sending."""
        ...
