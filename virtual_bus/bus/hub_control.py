"""What a client may ask of its own controller on a hub, and the broker's answer; beside the frames."""

import struct
from enum import IntEnum
from typing import NamedTuple

from virtual_bus.bus.error_state import ErrorState
from virtual_bus.bus.hub_protocol import MalformedRecord
from virtual_bus.bus.port import Port

_REQUEST = struct.Struct("<4sB")
_REQUEST_MAGIC = b"SBct"
_STATUS = struct.Struct("<4sBBBHHI")
_STATUS_MAGIC = b"SBst"
_ASKED, _UNPLUGGED, _LISTEN_ONLY, _ALONE = 1, 2, 4, 8
_STATES = tuple(ErrorState)


class Request(IntEnum):
    """What is asked; each is answered with a status."""

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
    """Of the last second, rounded."""
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


def obey(port: Port, request: Request) -> None:
    """Do what is asked of ``port``."""
    if request is Request.GO_BUS_OFF:
        port.go_bus_off()
    elif request is Request.RECOVER:
        port.recover()
    elif request is Request.UNPLUG:
        port.unplug()
    elif request is Request.PLUG:
        port.plug()
    elif request in (Request.LISTEN_ONLY, Request.LISTEN_AND_SPEAK):
        port.set_listen_only(request is Request.LISTEN_ONLY)


def encode_status(port: Port, load_percent: float, frames: int, *, asked: bool, alone: bool) -> bytes:
    """The state of ``port``, whose client is ``alone``; ``asked``: as an answer, else because it changed."""
    flags = _ASKED * asked | _UNPLUGGED * (not port.plugged) | _LISTEN_ONLY * port.listen_only
    flags |= _ALONE * alone
    return _STATUS.pack(
        _STATUS_MAGIC,
        _STATES.index(port.error_state),
        flags,
        min(round(load_percent), 0xFF),
        port.transmit_errors,
        port.receive_errors,
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
