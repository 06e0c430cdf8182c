"""drivers' core, written in C, as seen from Python; the sources beside this file document it."""

from collections.abc import Callable
from typing import Any, ClassVar

from servobench.drivers.timebase import Instant

SOURCES_DIGEST: str
"""Digest of the C sources of the core (servobench.design.core.build)."""

def nearest(value: float, /) -> int:
    """``round(value)`` of a float, in a third of its time. Error: ValueError, OverflowError for what is not
    finite."""

class WireFrame:
    """A classical CAN data or remote frame. Equal to another whose fields are equal."""

    __match_args__: ClassVar[tuple[str, ...]]

    def __init__(
        self,
        can_id: int,
        data: bytes = b"",
        extended: bool = False,
        remote: bool = False,
        remote_length: int = 0,
    ) -> None: ...
    def __eq__(self, other: object) -> bool: ...
    def __hash__(self) -> int: ...
    @property
    def can_id(self) -> int:
        """11 bits, or 29 if ``extended``."""

    @property
    def data(self) -> bytes:
        """0..8 bytes; empty for a remote frame."""

    @property
    def extended(self) -> bool: ...
    @property
    def remote(self) -> bool: ...
    @property
    def remote_length(self) -> int:
        """DLC of a remote frame; not used for a data frame."""
    handed_at: Instant
    """When its sender handed it over, if noted; -1, UNTOLD, if not. The echo on a simulated bus or a hub
    carries it, and so identifies its frame. Never on the wire, and not compared."""

def data_frame(can_id: int, data: bytes, /) -> WireFrame:
    """A data frame with an identifier of 11 bits, in a third of the time of the constructor."""

class Link:
    """Frames in and out of a bus by its port. A class on top of it has ``send_waiting(until)``, which returns
    when to look again, ``let_wait(frame, at)`` and ``tell_troubles()``; ``receiving_failed(error)``, which
    raises; ``transmitting_failed(error, at)``, which returns if the frame is to wait."""

    def __new__(cls, *arguments: Any, **named: Any) -> Any: ...
    def use(self, port: object, now: Callable[[], Instant], failures: tuple[type[Exception], ...], /) -> None:
        """Receive and transmit by ``port``, a FramePort (servobench.drivers.wire.frame_port); its errors
        ``failures`` go to the class on top. Error: ValueError if there is one already."""
    waits: bool
    """Whether frames wait for room; then each call begins with ``send_waiting``."""
    sent_frames: int
    received_frames: int
    echoed_frames: int
    ignored_frames: int
    error_frames: int
    @property
    def port(self) -> Any:
        """As given to :meth:`use`."""

    @property
    def last_id(self) -> int:
        """Identifier of the last frame fetched; ``last_data`` and ``last_at`` belong to it too."""

    @property
    def last_data(self) -> bytes: ...
    @property
    def last_at(self) -> Instant: ...
    @property
    def last_own(self) -> bool:
        """True if it is an echo."""

    @property
    def last_handed_at(self) -> Instant:
        """If it is an echo: when the frame was handed over, where the bus reports that."""

    @property
    def needs_watching(self) -> bool:
        """True if somebody must receive while time passes, or frames are stamped or sent late."""

    def show(self, tap: object, /) -> None:
        """Have ``tap``, a FrameTap, see every frame from now on. Error: ValueError for the 17th."""

    def fetch(self, until: Instant, /) -> bool:
        """Fetch a data frame or an echo by ``until`` into ``last_id``, ``last_data``, ``last_at`` and
        ``last_own``; False if none came. Lets time pass. Raises BusDown if the bus is gone."""

    def send(self, can_id: int, data: bytes, /) -> Instant:
        """Queue a frame; returns the instant just before the bus was offered it.

        Raises BusDown if the bus is gone, or has taken nothing for a second.
        """

    def hand_over(self, frame: WireFrame, /) -> Instant:
        """As :meth:`send`, of any frame."""

    def offer(self, frame: WireFrame, at: Instant, /) -> bool:
        """Offer ``frame`` to the bus at ``at``; False if it has no room for it now."""

class Pump:
    """Hands the frames of a link to their handlers; see servobench.drivers.canopen.frame_pump."""

    def __init__(
        self,
        link: Link,
        handlers: dict[int, Callable[[bytes, Instant], None]],
        echo_handlers: dict[int, Callable[[bytes, Instant, Instant], None]],
        others: Callable[[int, bytes, Instant], None],
        keep_house: Callable[[Instant], None],
        now: Callable[[], Instant],
        sleep_until: Callable[[Instant], None],
        /,
    ) -> None: ...
    housekeeping_at: Instant
    def pump_one(self, until: Instant, /) -> bool:
        """Handle the next frame and return True; False once ``until`` has come without one."""

    def pump(self, until: Instant, /) -> None:
        """Handle frames, send what falls due, and return once ``until`` has come; at once if it has passed.

        Frames already waiting are handled in either case.
        """

    def rest(self, until: Instant, /) -> None:
        """Let time pass like :meth:`pump`, but leave frames in the bus's queue until ``until``, or until
        housekeeping is due: one wake-up instead of one per frame. The bus stamps them, so nothing is lost; on
        a bus that needs watching this is :meth:`pump`."""
