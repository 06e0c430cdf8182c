"""The path of frames into and out of a bus, and the taps that see the frames passing a link.

A bus offers it as its ``frame_port``: frames with stamps on the bench's axis. Compiled, methods of a known
class are called directly, in a twentieth of the time.

Identifiers of CAN frames, and the flags beside them in the words of linux/can.h, of logs and of rows.
"""

from collections.abc import Callable
from enum import Enum
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from mypy_extensions import mypyc_attr

from servobench.drivers.core.native import WireFrame as WireFrame
from servobench.drivers.timebase import Instant

if TYPE_CHECKING:
    from can.typechecking import CanFilters


Direction = Literal["tx", "rx"]
Tap = Callable[[Direction, int, bytes, bool, bool, Instant], None]
"""Sees every frame: direction, identifier, data, extended, remote, instant."""


UNTOLD: Final = Instant(-1)
"""The instant of a hand-over is unknown."""


def accepts(filters: "CanFilters", frame: WireFrame) -> bool:
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

    native: object | None = None
    """The same in C (design/core/frames.h), which a link then calls in the place of both: a port that needs
    no watching and has no troubles."""

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

    native: object | None = None
    """The same in C (design/core/frames.h), which a link then calls in its place."""

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


STANDARD_ID_MAX: Final = 0x7FF
EXTENDED_ID_MAX: Final = 0x1FFF_FFFF

ERROR_FLAG: Final = 1 << 29
"""CAN_ERR_FLAG. Marks the identifier of an error frame, reported by the adapter."""
REMOTE_FLAG: Final = 1 << 30
"""CAN_RTR_FLAG."""
EXTENDED_FLAG: Final = 1 << 31
"""CAN_EFF_FLAG."""
