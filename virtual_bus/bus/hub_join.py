"""Join a hub, and start its broker if there is none."""

import socket
import subprocess

import can

from drivers.timebase import NS_PER_S, Clock, Duration
from virtual_bus.bus.hub_place import HubPlace
from virtual_bus.bus.hub_protocol import (
    PACKET_BYTES_MAX,
    Hello,
    MalformedRecord,
    decode_answer,
    encode_hello,
)
from virtual_bus.child_python import python_command, python_environment

DEFAULT_BITRATE_BIT_S = 1_000_000
_ANSWER_PATIENCE_S = 10.0
_START_PATIENCE_S = 60.0
_SEND_BUFFER_BYTES = 131_072
"""Over 127 frames under way to the broker, a sub-block of an SDO block transfer sent at once (CiA 301,
7.2.4.3.10); beyond them and its own queue ``send`` reports a full queue."""


def join(place: HubPlace, hello: Hello, clock: Clock) -> tuple[socket.socket, int]:
    """A connection to the hub, non-blocking, and the hub's bit rate.

    Raises can.CanInitializationError if the hub refuses, does not answer or cannot be started.
    """
    joined = _try_to_join(place, hello)
    if joined is None:
        with place.locked(clock, Duration(round(_START_PATIENCE_S * NS_PER_S))):
            joined = _try_to_join(place, hello)  # another process may have started it meanwhile
            if joined is None:
                _start(place, hello.bitrate_bit_s or DEFAULT_BITRATE_BIT_S)
                joined = _try_to_join(place, hello)
    if joined is None:
        raise can.CanInitializationError(f"hub {place.name!r}: its broker ended at once; see {place.log}")
    return joined


def _try_to_join(place: HubPlace, hello: Hello) -> tuple[socket.socket, int] | None:
    """None if no broker is there, or it is just leaving."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        connection.settimeout(_ANSWER_PATIENCE_S)
        connection.connect(str(place.socket))
        connection.send(encode_hello(hello))
        packet = connection.recv(PACKET_BYTES_MAX)
    except (FileNotFoundError, ConnectionError):
        connection.close()
        return None
    except OSError as error:
        connection.close()
        raise can.CanInitializationError(f"hub {place.name!r} does not answer: {error}") from error
    if not packet:
        connection.close()
        return None
    return _answered(place, connection, packet)


def _answered(place: HubPlace, connection: socket.socket, packet: bytes) -> tuple[socket.socket, int]:
    try:
        answer = decode_answer(packet)
    except MalformedRecord as error:
        answer = f"hub {place.name!r}: {error}; another program listens on {place.socket}"
    if isinstance(answer, str):
        connection.close()
        raise can.CanInitializationError(answer)
    connection.setblocking(False)
    return connection, answer


def _start(place: HubPlace, bitrate_bit_s: int) -> None:
    """Start the broker; it runs when this returns. Call it under the hub's lock."""
    command = python_command("virtual_bus.bus.hub_process", place.name, str(bitrate_bit_s))
    with place.log.open("wb") as log:
        try:
            status = subprocess.run(
                command,
                env=python_environment(),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                timeout=_START_PATIENCE_S,
                check=False,
            ).returncode
        except subprocess.TimeoutExpired as error:
            raise can.CanInitializationError(f"hub {place.name!r}: its broker does not start") from error
    if status != 0:
        evidence = place.log.read_text(errors="replace").strip().splitlines()[-1:]
        raise can.CanInitializationError(f"hub {place.name!r}: its broker failed: {' '.join(evidence)}")
