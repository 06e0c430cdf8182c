"""The lean path of a bus: frames as plain tuples, with stamps that are on the bench's axis already.

A bus may offer it beside python-can's ``recv`` and ``send``.
"""

from typing import Protocol, runtime_checkable

from drivers.frame_port import FramePort
from drivers.frame_port import WireFrame as WireFrame
from drivers.timebase import Instant


@runtime_checkable
class LeanBus(Protocol):
    """The lean path of a bus."""

    def recv_frame(self, until: Instant) -> tuple[WireFrame, Instant] | None:
        """The next frame and its stamp on the bench's axis; None once ``until`` has come."""
        ...

    def send_frame(self, frame: WireFrame) -> None:
        """Queue a frame for sending."""
        ...


class PortOfLeanBus(FramePort):
    """The lean path of a bus that has no port of its own."""

    def __init__(self, bus: LeanBus) -> None:
        super().__init__()
        self._recv_frame = bus.recv_frame
        self._send_frame = bus.send_frame

    def receive(self, until: Instant) -> WireFrame | None:
        item = self._recv_frame(until)
        if item is None:
            return None
        frame, self.came_at = item
        return frame

    def transmit(self, frame: WireFrame) -> None:
        self._send_frame(frame)
