"""The frame port of a bus, as tests use it, and frames as an inlet keeps them."""

import struct
from collections.abc import Iterable
from typing import Any

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import FramePort, WireFrame


def fetched(bus: Any, until: Instant) -> tuple[WireFrame, Instant] | None:
    """The next frame of ``bus`` by its port, and its stamp; None once ``until`` has come."""
    port: FramePort = bus.frame_port
    frame = port.receive(until)
    return None if frame is None else (frame, port.came_at)


def kept_rows(frames: Iterable[tuple[bytes, Instant]]) -> bytes:
    """Return data and instants of frames in the rows of ``Inlet.take_kept``."""
    return b"".join(struct.pack("=q8sq", at, data, len(data)) for data, at in frames)
