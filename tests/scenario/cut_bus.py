"""A bus that goes away, for good or until it is mended."""

from typing import Any

import can

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import FramePort, WireFrame


class CutPort(FramePort):
    """The port of a bus that goes away."""

    def __init__(self, bus: "CutBus") -> None:
        super().__init__()
        self._bus = bus
        self._inner: FramePort = bus.inner.frame_port
        self.echoes = self._inner.echoes

    def receive(self, until: Instant) -> WireFrame | None:
        self._bus.check()
        frame = self._inner.receive(until)
        while frame is not None and self._bus.unplugged:
            frame = self._inner.receive(until)
        self.came_at, self.came_own = self._inner.came_at, self._inner.came_own
        return frame

    def transmit(self, frame: WireFrame) -> None:
        self._bus.check()
        self._bus.sent += 1
        if not self._bus.unplugged:
            self._inner.transmit(frame)


class CutBus(can.BusABC):
    """A bus that goes away after so many more frames were sent, until it is mended."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner
        self.channel_info = "cut bus"
        self.sent = 0
        self.cut_at: int | None = None
        self.unplugged_at: int | None = None
        """From then on nobody hears it, and it hears nobody."""
        self.frame_port = CutPort(self)
        self._is_shutdown = True
        self._filters = None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Not used: the frame port is there."""
        raise NotImplementedError

    def shutdown(self) -> None:
        """Of the inner bus."""
        self.inner.shutdown()

    @property
    def unplugged(self) -> bool:
        """The drive's plug is out."""
        return self.unplugged_at is not None and self.sent >= self.unplugged_at

    def check(self) -> None:
        """Raises can.CanOperationError if it is gone."""
        if self.cut_at is not None and self.sent >= self.cut_at:
            raise can.CanOperationError("the cable is out")
