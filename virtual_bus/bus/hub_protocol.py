"""Packets between a hub's broker and its clients.

The client opens with a hello; the broker answers with a welcome, or with a refusal in words and closes.
From then on a packet of the client is one frame, or a request to its controller; a packet of the broker is
one frame, or as many as fit (a batch) if the client has asked for that, or tells of the client's controller.
"""

import struct
from collections.abc import Callable
from enum import IntEnum
from typing import Final, NamedTuple

from servobench.drivers.timebase import NS_PER_US, Instant
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.port import Port
from servobench.virtual_bus.core.native import HUB_FRAME_BYTES, HUB_PACKET_BYTES_MAX, pack_frame, unpack_frame
from servobench.virtual_bus.frame import Frame

VERSION = 5
PACKET_BYTES_MAX: Final = HUB_PACKET_BYTES_MAX

_HELLO = struct.Struct("<4sHHI")
_HELLO_MAGIC = b"SBhi"
_WELCOME = struct.Struct("<4sHHIq")
_WELCOME_MAGIC = b"SBok"
_REFUSAL_MAGIC = b"SBno"
FRAME_BYTES: Final = HUB_FRAME_BYTES
BATCH_FRAMES_MAX: Final = PACKET_BYTES_MAX // FRAME_BYTES
_RECEIVE_OWN, _BATCHES = 1, 2

ECHO_HELD_NS: Final = 350 * NS_PER_US
"""For how long the broker keeps an own frame that a client wants back, for a frame of another node to go with
it. A drive answers a SYNC within some 300 us, of which the frame takes 130: the echo of the SYNC then wakes
nobody that waits for the TPDOs. That of a command, half a millisecond later, has come by the next tick at
1 kHz."""


class MalformedRecord(ValueError):
    """A packet that is no record of this protocol."""


class Hello(NamedTuple):
    """How a client introduces itself."""

    bitrate_bit_s: int
    """The bit rate it counts on; 0: whatever the hub runs at."""
    receive_own: bool
    """True: it wants its own frames back at their end of frame."""
    batches: bool = True
    """True: it takes several frames in one packet, its own frames then up to ``ECHO_HELD_NS`` late."""


class Received(NamedTuple):
    """A frame off the hub."""

    frame: Frame
    at: Instant
    """End of frame on CLOCK_MONOTONIC, ns; 0 on the way to the broker."""
    own: bool
    """Sent by the client that gets it."""


def encode_hello(hello: Hello) -> bytes:
    """The client's first packet."""
    flags = _RECEIVE_OWN * hello.receive_own | _BATCHES * hello.batches
    return _HELLO.pack(_HELLO_MAGIC, VERSION, flags, hello.bitrate_bit_s)


def decode_hello(packet: bytes) -> Hello:
    """Raises MalformedRecord for anything but a hello of this version."""
    if len(packet) != _HELLO.size:
        raise MalformedRecord("not a hello")
    magic, version, flags, bitrate = _HELLO.unpack(packet)
    if magic != _HELLO_MAGIC:
        raise MalformedRecord("not a hello")
    if version != VERSION:
        raise MalformedRecord(
            f"the hub speaks version {VERSION} of its protocol and the client version {version}"
        )
    return Hello(bitrate, bool(flags & _RECEIVE_OWN), bool(flags & _BATCHES))


class Welcome(NamedTuple):
    """The broker's answer to a client that it takes in."""

    bitrate_bit_s: int
    now: Instant
    """By the broker's CLOCK_MONOTONIC, in which all stamps are."""


def encode_welcome(bitrate_bit_s: int, now: Instant) -> bytes:
    """The broker's answer to a client that it takes in."""
    return _WELCOME.pack(_WELCOME_MAGIC, VERSION, 0, bitrate_bit_s, now)


def encode_refusal(reason: str) -> bytes:
    """The broker's answer to a client that it does not take in."""
    return _REFUSAL_MAGIC + reason.encode()[: PACKET_BYTES_MAX - len(_REFUSAL_MAGIC)]


def decode_answer(packet: bytes) -> Welcome | str:
    """A welcome, or the words of the refusal. Raises MalformedRecord for anything else."""
    if packet.startswith(_REFUSAL_MAGIC):
        return packet[len(_REFUSAL_MAGIC) :].decode(errors="replace")
    if len(packet) != _WELCOME.size or not packet.startswith(_WELCOME_MAGIC):
        raise MalformedRecord("the hub's answer is none of this protocol")
    _, _, _, bitrate, now = _WELCOME.unpack(packet)
    return Welcome(bitrate, Instant(now))


def encode_frame(frame: Frame, at: Instant = Instant(0), own: bool = False) -> bytes:  # noqa: B008
    """A frame as one packet."""
    return pack_frame(frame, at, own)


def decode_frame(packet: bytes) -> Received:
    """Raises MalformedRecord for a packet that no valid frame encodes to."""
    try:
        frame, at, own = unpack_frame(packet)
    except ValueError as error:
        raise MalformedRecord(str(error)) from None
    return Received(frame, at, own)


_REQUEST = struct.Struct("<4sB")
_REQUEST_MAGIC = b"SBct"
_STATUS = struct.Struct("<4sBBBHHI")
_STATUS_MAGIC = b"SBst"
_ASKED, _UNPLUGGED, _LISTEN_ONLY, _ALONE = 1, 2, 4, 8
_STATES = tuple(ErrorState)


class Request(IntEnum):
    """A request; each is answered with a status."""

    STATUS = 0
    GO_BUS_OFF = 1
    RECOVER = 2
    UNPLUG = 3
    PLUG = 4
    LISTEN_ONLY = 5
    LISTEN_AND_SPEAK = 6


class HubStatus(NamedTuple):
    """One client's controller and the hub's bus."""

    error_state: ErrorState
    transmit_errors: int
    receive_errors: int
    plugged: bool
    listen_only: bool
    load_percent: int
    """Load in the last second, rounded."""
    frames: int
    """On the bus since the hub was started, modulo 2**32."""
    alone: bool
    """No other client is on the hub."""


def encode_request(request: Request) -> bytes:
    """A request as one packet; none is as long as a frame."""
    return _REQUEST.pack(_REQUEST_MAGIC, request)


def decode_request(packet: bytes) -> Request | None:
    """None if ``packet`` is no request. Raises MalformedRecord for one that nobody knows."""
    if len(packet) != _REQUEST.size or not packet.startswith(_REQUEST_MAGIC):
        return None
    number = _REQUEST.unpack(packet)[1]
    if number not in tuple(Request):
        raise MalformedRecord(f"request {number}")
    return Request(number)


ACTIONS: Final[dict[Request, Callable[[Port], None]]] = {
    Request.STATUS: lambda _port: None,
    Request.GO_BUS_OFF: lambda port: port.go_bus_off(),
    Request.RECOVER: lambda port: port.recover(),
    Request.UNPLUG: lambda port: port.unplug(),
    Request.PLUG: lambda port: port.plug(),
    Request.LISTEN_ONLY: lambda port: port.set_listen_only(True),
    Request.LISTEN_AND_SPEAK: lambda port: port.set_listen_only(False),
}
"""Action at the requester's port, before the answer."""


def encode_status(port: Port, load_percent: float, frames: int, *, asked: bool, alone: bool) -> bytes:
    """The state of ``port``, whose client is ``alone``; ``asked``: as an answer, else because it changed."""
    controller = port.controller
    flags = _ASKED * asked | _UNPLUGGED * (not controller.plugged) | _LISTEN_ONLY * controller.listen_only
    flags |= _ALONE * alone
    return _STATUS.pack(
        _STATUS_MAGIC,
        _STATES.index(controller.state),
        flags,
        min(round(load_percent), 0xFF),
        controller.transmit_errors,
        controller.receive_errors,
        frames & 0xFFFF_FFFF,
    )


def decode_status(packet: bytes) -> tuple[HubStatus, bool] | None:
    """A status, and whether it answers a request; None if ``packet`` is none."""
    if len(packet) != _STATUS.size or not packet.startswith(_STATUS_MAGIC):
        return None
    _, state, flags, load, transmit, receive, frames = _STATUS.unpack(packet)
    status = HubStatus(
        _STATES[state],
        transmit,
        receive,
        not flags & _UNPLUGGED,
        bool(flags & _LISTEN_ONLY),
        load,
        frames,
        bool(flags & _ALONE),
    )
    return status, bool(flags & _ASKED)
