"""The frame and the device, as the simulated world sees them."""

from collections.abc import Sequence
from typing import Protocol

from servobench.drivers.core.native import WireFrame as Frame
from servobench.drivers.timebase import Instant

__all__ = ["Device", "Frame"]
"""The frame is one class on both sides of the wire, and no alias of it: compiled, an alias is called as any
object is, a class directly."""


class Device(Protocol):
    """A device without I/O: frames and time in, frames out.

    The host calls ``start`` once, then ``receive`` for each frame of the bus that the
    device did not send itself, and ``wake`` whenever ``wake_at`` is reached. ``now``
    never runs backwards. Each call returns the frames to send, in order, and may
    change ``wake_at``. A device that has ``heard``, a dictionary by identifier, is spared on a
    simulated segment all other data frames.
    """

    @property
    def wake_at(self) -> Instant | None:
        """When the device wants its next ``wake``; None: only on a frame."""
        ...

    def start(self, now: Instant) -> Sequence[Frame]:
        """Power on."""
        ...

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """A frame ended on the bus at ``now``."""
        ...

    def wake(self, now: Instant) -> Sequence[Frame]:
        """``wake_at`` has been reached (``now`` may be later)."""
        ...
