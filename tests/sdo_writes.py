"""A device on a simulated bus that hears what others write by SDO, with a decoder of its own.

Source: CiA 301 7.2.4.3, the requests of the SDO protocols.
"""

from collections.abc import Sequence
from typing import Final

from servobench.drivers.canopen.write_list import Product, WriteList
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.frame import Frame

REQUESTS: Final = range(0x601, 0x680)
OF_MAKERS: Final = range(0x2000, 0x6000)


def written(frame: Frame) -> tuple[int, int] | None:
    """Index and sub-index that a frame begins to write: expedited, in segments or in blocks."""
    if frame.can_id not in REQUESTS or len(frame.data) != 8 or frame.extended or frame.remote:
        return None
    first = frame.data[0]
    download = 0x20 <= first < 0x40
    blocks = first & 0b1110_0001 == 0b1100_0000
    return (frame.data[1] + 256 * frame.data[2], frame.data[3]) if download or blocks else None


class SdoWrites:
    """Hears the bus and sends nothing."""

    def __init__(self) -> None:
        self.wake_at: Instant | None = None
        self.objects: set[tuple[int, int]] = set()
        """All that was written, by whatever node."""
        self.asked: set[tuple[int, int]] = set()
        """All that was written or read."""

    def start(self, now: Instant) -> Sequence[Frame]:
        del now
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        del now
        key = written(frame)
        if key is not None:
            self.objects.add(key)
        if key is not None or (frame.can_id in REQUESTS and 0x40 <= frame.data[0] < 0x60):
            self.asked.add((frame.data[1] + 256 * frame.data[2], frame.data[3]))
        return ()

    def unlisted(self, allowed: WriteList, product: Product | None = None) -> list[str]:
        """What was written though the list does not allow it on ``product``; None: a drive of any make.
        Error: AssertionError for a bus on which nothing was written."""
        assert self.objects, "no write was heard"
        return [
            f"{index:04X}h:{sub:02X}"
            for index, sub in self.objects
            if not allowed.allows(index, sub, product)
        ]

    def wake(self, now: Instant) -> Sequence[Frame]:
        del now
        return ()
