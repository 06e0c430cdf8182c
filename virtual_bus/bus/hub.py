"""python-can's view of a hub: a CAN bus in real time between the processes of one user.

``can.Bus(interface="hub", channel="bench", bitrate=1_000_000)``. The first to join starts
the hub's broker (servobench.virtual_bus.bus.hub_process), which leaves after the last one.
"""

import errno
import select
import socket
import struct
import subprocess

import can
from can.typechecking import AutoDetectedConfig, CanFilters

from servobench.drivers.timebase import (
    NEVER,
    NS_PER_MS,
    NS_PER_S,
    Clock,
    Duration,
    Instant,
    MonotonicClock,
    instant_after,
)
from servobench.drivers.wire.message import frame_of, message_of
from servobench.virtual_bus.bus.error_message import bus_state
from servobench.virtual_bus.bus.hub_place import HubPlace, known_hubs
from servobench.virtual_bus.bus.hub_port import HubPort
from servobench.virtual_bus.bus.hub_protocol import (
    PACKET_BYTES_MAX,
    Hello,
    HubStatus,
    MalformedRecord,
    Request,
    Welcome,
    decode_answer,
    encode_hello,
)
from servobench.virtual_bus.child_python import python_command, python_environment


class HubBus(can.BusABC):
    """One participant of a hub.

    A message's timestamp is its end of frame on CLOCK_MONOTONIC, in seconds, as the broker
    computed it. Own frames come back, with ``is_rx`` False, only if ``receive_own_messages``.
    ``send`` and ``recv`` may be called from different threads.
    """

    def __init__(
        self,
        channel: str,
        can_filters: CanFilters | None = None,
        *,
        bitrate: int | None = None,
        receive_own_messages: bool = False,
        batches: bool = False,
        **_: object,
    ) -> None:
        """Join, and start the hub if it is not there.

        ``bitrate`` in bit/s; None joins at whatever the hub runs at, and starts it at 1 Mbit/s.
        ``batches``: take several frames at one read, which is cheaper, and for who waits on :meth:`fileno`
        wrong, as only the first of them shows there; own frames may then come 0.35 ms late.
        Raises can.CanInitializationError for a bad name, another bit rate than the hub's, and
        a hub that does not start or answer.
        """
        self._clock = MonotonicClock()
        hello = Hello(bitrate or 0, receive_own_messages, batches)
        self._socket, self.bitrate_bit_s = join(HubPlace(str(channel)), hello, self._clock)
        self.channel_info = f"hub:{channel}"
        self._channel = str(channel)
        self.frame_port = HubPort(self._socket, self.channel_info, self._clock, receive_own_messages)
        """Its frames without python-can."""
        super().__init__(channel, can_filters)

    def status(self) -> HubStatus:
        """This client's controller and the bus. Raises can.CanOperationError if the broker is gone."""
        return self.frame_port.ask(Request.STATUS)

    def go_bus_off(self) -> HubStatus:
        """Take this client's controller off the bus, as after too many errors; its queue is lost."""
        return self.frame_port.ask(Request.GO_BUS_OFF)

    def recover(self) -> HubStatus:
        """Let the controller begin to recover, which takes 128 times 11 recessive bits."""
        return self.frame_port.ask(Request.RECOVER)

    def unplug(self) -> HubStatus:
        """Take this client off the wire: it hears and sends nothing, and keeps its queue."""
        return self.frame_port.ask(Request.UNPLUG)

    def plug(self) -> HubStatus:
        """Put this client back on the wire."""
        return self.frame_port.ask(Request.PLUG)

    def set_listen_only(self, listen_only: bool) -> HubStatus:
        """Only listen, or speak again."""
        return self.frame_port.ask(Request.LISTEN_ONLY if listen_only else Request.LISTEN_AND_SPEAK)

    @property
    def state(self) -> can.BusState:
        """State known from received packets: ERROR is bus-off. See :meth:`status`."""
        return bus_state(self.frame_port.error_state)

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        """Raises NotImplementedError: the state is what the counters make it."""
        raise NotImplementedError("the error state follows the error counters; see set_listen_only")

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message; None after ``timeout`` seconds.

        Raises can.CanOperationError if the broker is gone or the bus is shut down.
        """
        port = self.frame_port
        frame = port.receive(NEVER if timeout is None else instant_after(self._clock.now(), timeout))
        if frame is None:
            return None
        return message_of(frame, port.came_at, is_rx=not port.came_own, channel=self._channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand ``msg`` to the hub, waiting up to ``timeout`` seconds for a place in a full queue.

        Raises can.CanOperationError if there is none, the broker is gone, or the message is
        none of classical CAN.
        """
        frame = frame_of(msg)
        deadline = instant_after(self._clock.now(), timeout or 0.0)
        while True:
            try:
                self.frame_port.transmit(frame)
            except can.CanOperationError as error:
                if error.error_code != errno.ENOBUFS or not self._wait_for_room(deadline):
                    raise
            else:
                return

    def fileno(self) -> int:
        """The socket, for an event loop to watch; -1 once shut down."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Leave the hub; what was sent still goes out."""
        super().shutdown()
        self.frame_port.close()

    def _apply_filters(self, filters: CanFilters | None) -> None:
        self.frame_port.filter(filters)

    def _wait_for_room(self, deadline: Instant) -> bool:
        remaining_ns = deadline - self._clock.now()
        if remaining_ns <= 0:
            return False
        room = select.poll()  # no select: the descriptor may be any
        room.register(self._socket, select.POLLOUT)
        room.poll(remaining_ns / NS_PER_MS)
        return True

    @staticmethod
    def _detect_available_configs() -> list[AutoDetectedConfig]:
        return [{"interface": "hub", "channel": name} for name in known_hubs()]


DEFAULT_BITRATE_BIT_S = 1_000_000
"""That of a bench file and of the commands that name none."""
_ANSWER_PATIENCE = struct.pack("@ll", 10, 0)
"""Seconds and microseconds (struct timeval). A broker that runs answers within 1 ms; a process of a busy
machine may be kept waiting for seconds. The limit is the kernel's: a socket with a time-out of Python's does
not wait for a place in a full queue of connections."""
_START_PATIENCE_S = 60.0
"""Twenty times what a start took on two cores that had fourteen processes to serve, 3 s."""
_SEND_BUFFER_BYTES = 131_072
"""Over 127 frames under way to the broker, a sub-block of an SDO block transfer sent at once (CiA 301,
7.2.4.3.10); beyond them and its own queue ``send`` reports a full queue."""


def join(place: HubPlace, hello: Hello, clock: Clock) -> tuple[socket.socket, int]:
    """A connection to the hub, non-blocking, and the hub's bit rate.

    Raises can.CanInitializationError if the hub refuses, does not answer or cannot be started.
    """
    joined = _try_to_join(place, hello, clock)
    if joined is None:
        with place.locked(clock, Duration(round(_START_PATIENCE_S * NS_PER_S))):
            joined = _try_to_join(place, hello, clock)  # another process may have started it meanwhile
            if joined is None:
                _start(place, hello.bitrate_bit_s or DEFAULT_BITRATE_BIT_S)
                joined = _try_to_join(place, hello, clock)
    if joined is None:
        raise can.CanInitializationError(f"hub {place.name!r}: its broker ended at once; see {place.log}")
    return joined


def _try_to_join(place: HubPlace, hello: Hello, clock: Clock) -> tuple[socket.socket, int] | None:
    """None if no broker is there, or it is just leaving."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        for limit in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            connection.setsockopt(socket.SOL_SOCKET, limit, _ANSWER_PATIENCE)
        connection.connect(str(place.socket))
        asked_at = clock.now()
        connection.send(encode_hello(hello))
        packet = connection.recv(PACKET_BYTES_MAX)
        answered_at = clock.now()
    except (FileNotFoundError, ConnectionError):
        connection.close()
        return None
    except OSError as error:
        connection.close()
        raise can.CanInitializationError(f"hub {place.name!r} does not answer: {error}") from error
    if not packet:
        connection.close()
        return None
    return _answered(place, connection, packet, (asked_at, answered_at))


def _answered(
    place: HubPlace, connection: socket.socket, packet: bytes, during: tuple[Instant, Instant]
) -> tuple[socket.socket, int]:
    """``during``: from the hello to the answer, in which the broker has read its clock."""
    try:
        answer: Welcome | str = decode_answer(packet)
    except MalformedRecord as error:
        answer = f"hub {place.name!r}: {error}; another program listens on {place.socket}"
    if isinstance(answer, Welcome) and not during[0] <= answer.now <= during[1]:
        answer = (
            f"hub {place.name!r}: its clock (CLOCK_MONOTONIC) is not this process's; run both in one time"
            " namespace"
        )
    if isinstance(answer, str):
        connection.close()
        raise can.CanInitializationError(answer)
    connection.setblocking(False)
    return connection, answer.bitrate_bit_s


def _start(place: HubPlace, bitrate_bit_s: int) -> None:
    """Start the broker; it runs when this returns. Call it under the hub's lock."""
    command = python_command("servobench.virtual_bus.bus.hub_process", place.name, str(bitrate_bit_s))
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
