"""The path of frames into and out of a bus, and the taps that see the frames passing a link.

A bus offers it as its ``frame_port``: frames with stamps on the bench's axis. Compiled, methods of a known
class are called directly, in a twentieth of the time.
"""

from collections.abc import Callable
from enum import Enum
from typing import Final, Literal, NamedTuple

from can.typechecking import CanFilters
from mypy_extensions import mypyc_attr

from servobench.drivers.record import Record
from servobench.drivers.timebase import Instant

Direction = Literal["tx", "rx"]
Tap = Callable[[Direction, int, bytes, bool, bool, Instant], None]
"""Sees every frame: direction, identifier, data, extended, remote, instant."""


UNTOLD: Final = Instant(-1)
"""The instant of a hand-over is unknown."""


@mypyc_attr(acyclic=True, free_list_len=1)
class WireFrame(Record):
    """A classical CAN data or remote frame."""

    __match_args__ = ("can_id", "data", "extended", "remote", "remote_length")
    __slots__ = (*__match_args__, "handed_at", "wire_id")

    def __init__(
        self,
        can_id: int,
        data: bytes = b"",
        extended: bool = False,
        remote: bool = False,
        remote_length: int = 0,
    ) -> None:
        self.can_id: Final = can_id
        """11 bits, or 29 if ``extended``."""
        self.data: Final = data
        """0..8 bytes; empty for a remote frame."""
        self.extended: Final = extended
        self.remote: Final = remote
        self.remote_length: Final = remote_length
        """DLC of a remote frame; not used for a data frame."""
        self.wire_id: Final = can_id << 2 | remote << 1 | extended
        """Identifier and format as one number: the simulated bus reads it at once."""
        self.handed_at = UNTOLD
        """When its sender handed it over, if noted. The echo on a simulated bus or a hub carries it, and so
        identifies its frame. Never on the wire, and not compared."""


def accepts(filters: CanFilters, frame: WireFrame) -> bool:
    """Return True if at least one filter matches: equal under its mask, and of its format if it names one."""
    for one in filters:
        if "extended" in one and one["extended"] != frame.extended:
            continue
        if not (one["can_id"] ^ frame.can_id) & one["can_mask"]:
            return True
    return False


class EchoBasis(Enum):
    """Origin of the instants of own frames that were on the bus."""

    NONE = "none"
    """Own frames do not come back."""
    RECEIPT = "receipt"
    """They come back, stamped when this process received them."""
    KERNEL = "kernel"
    """They come back with the kernel's stamp."""
    HARDWARE = "hardware"
    """They come back with the adapter's stamp."""
    BUS = "bus"
    """They come back with the computed end of frame, and identify their frame: simulated bus and hub."""


class Trouble(NamedTuple):
    """An event that happened to an adapter."""

    text: str
    """Text that continues after its name."""
    at: Instant
    unheard: bool = False
    """True if frames that were on the bus before, echoes included, may have been missed."""


@mypyc_attr(allow_interpreted_subclasses=True)
class FramePort:
    """The ``frame_port`` of a bus. Override both methods."""

    def __init__(self) -> None:
        self.came_at = Instant(0)
        """Stamp of the last frame received."""
        self.came_own = False
        """True if that is one of our own that has been on the bus: an echo. It says nothing about
        delivery."""
        self.echoes = EchoBasis.NONE
        self.needs_watching = False
        """True if somebody must be inside ``receive`` while time passes: else frames are stamped or sent
        late."""
        self.troubles: list[Trouble] = []
        """Events of the adapter not reported yet."""
        self.cure = ""
        """The cure for the adapter's present state, if known; empty while it is sound."""

    def receive(self, until: Instant) -> WireFrame | None:
        """Return the next frame; None once ``until`` has come and none is waiting."""
        raise NotImplementedError

    def transmit(self, frame: WireFrame) -> None:
        """Queue a frame for sending. Raises can.CanOperationError; its code is ENOBUFS where there is no room
        now, ENETDOWN where the interface is down and may come up again."""
        raise NotImplementedError


@mypyc_attr(allow_interpreted_subclasses=True)
class FrameTap:
    """Sees every frame of a link. This one ignores all."""

    def frame(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        """``direction``: "tx" or "rx"."""


class CallbackTap(FrameTap):
    """A function as a tap."""

    def __init__(self, callback: Tap) -> None:
        self._callback = callback

    def frame(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        self._callback("tx" if direction == "tx" else "rx", can_id, data, extended, remote, at)
