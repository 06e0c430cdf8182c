"""A function at a port of a simulated segment."""

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.bus.port import Listener, OnFrame
from servobench.virtual_bus.frame import Frame


class Hearing(Listener):
    """Gets each frame of the others with its end of frame."""

    def __init__(self, on_frame: OnFrame) -> None:
        self._on_frame = on_frame

    def on_frame(self, frame: Frame, now: Instant) -> None:
        self._on_frame(frame, now)
