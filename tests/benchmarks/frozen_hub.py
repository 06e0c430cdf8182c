"""The hub's client as it was before it took batches and was compiled: what bench_hub_cycle compares with.

Not to be improved: an exception, a select and a second read for each frame that is waited for. It differs
from what it was only in that it asks the broker for one frame a packet.
"""

import errno
import select
from collections import deque
from typing import NoReturn

import can
from can.typechecking import AutoDetectedConfig, CanFilters

from servobench.drivers.timebase import NS_PER_S, Instant, MonotonicClock, instant_after
from servobench.drivers.wire.frame_port import accepts
from servobench.drivers.wire.message import frame_of, message_of
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.error_message import bus_state
from servobench.virtual_bus.bus.hub import join
from servobench.virtual_bus.bus.hub_place import HubPlace, known_hubs
from servobench.virtual_bus.bus.hub_protocol import (
    FRAME_BYTES,
    Hello,
    HubStatus,
    Received,
    Request,
    decode_frame,
    decode_status,
    encode_frame,
    encode_request,
)
from servobench.virtual_bus.frame import Frame

_WAIT_MAX_S = 3_600.0
_NEVER = Instant(1 << 62)
_ANSWER_MAX_S = 5.0
_ASK_AGAIN_S = 0.01
"""Another thread that reads may have taken in the answer."""


class FrozenHubBus(can.BusABC):
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
        **_: object,
    ) -> None:
        """Join, and start the hub if it is not there.

        ``bitrate`` in bit/s; None joins at whatever the hub runs at, and starts it at 1 Mbit/s.
        Raises can.CanInitializationError for a bad name, another bit rate than the hub's, and
        a hub that does not start or answer.
        """
        self._clock = MonotonicClock()
        place = HubPlace(str(channel))
        self._socket, self.bitrate_bit_s = join(
            place, Hello(bitrate or 0, receive_own_messages, batches=False), self._clock
        )
        self.channel_info = f"hub:{channel}"
        self._channel = str(channel)
        self._kept: deque[Received] = deque()
        self._answers: deque[HubStatus] = deque()
        self._error_state = ErrorState.ACTIVE
        super().__init__(channel, can_filters)

    def recv_frame(self, until: Instant) -> tuple[Frame, Instant] | None:
        """The next frame and its end of frame; None at ``until`` (CLOCK_MONOTONIC).

        Raises can.CanOperationError if the broker is gone.
        """
        received = self._receive(until)
        return None if received is None else received[:2]

    def send_frame(self, frame: Frame) -> None:
        """Hand ``frame`` to the hub. Raises can.CanOperationError if the queue is full or the broker gone."""
        try:
            self._socket.send(encode_frame(frame))
        except BlockingIOError:
            raise self._full() from None
        except OSError as error:
            self._lost(error)
        self._check_state()

    def status(self) -> HubStatus:
        """This client's controller and the bus. Raises can.CanOperationError if the broker is gone."""
        return self._ask(Request.STATUS)

    def go_bus_off(self) -> HubStatus:
        """Take this client's controller off the bus, as after too many errors; its queue is lost."""
        return self._ask(Request.GO_BUS_OFF)

    def recover(self) -> HubStatus:
        """Let the controller begin to recover, which takes 128 times 11 recessive bits."""
        return self._ask(Request.RECOVER)

    def unplug(self) -> HubStatus:
        """Take this client off the wire: it hears and sends nothing, and keeps its queue."""
        return self._ask(Request.UNPLUG)

    def plug(self) -> HubStatus:
        """Put this client back on the wire."""
        return self._ask(Request.PLUG)

    def set_listen_only(self, listen_only: bool) -> HubStatus:
        """Only listen, or speak again."""
        return self._ask(Request.LISTEN_ONLY if listen_only else Request.LISTEN_AND_SPEAK)

    @property
    def state(self) -> can.BusState:
        """As far as it is known from what was received: ERROR is bus-off. See :meth:`status`."""
        return bus_state(self._error_state)

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        """Raises NotImplementedError: the state is what the counters make it."""
        raise NotImplementedError("the error state follows the error counters; see set_listen_only")

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message; None after ``timeout`` seconds.

        Raises can.CanOperationError if the broker is gone or the bus is shut down.
        """
        until = _NEVER if timeout is None else instant_after(self._clock.now(), timeout)
        received = self._receive(until)
        if received is None:
            return None
        frame, at, own = received
        return message_of(frame, at, is_rx=not own, channel=self._channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand ``msg`` to the hub, waiting up to ``timeout`` seconds for a place in a full queue.

        Raises can.CanOperationError if there is none, the broker is gone, or the message is
        none of classical CAN.
        """
        packet = encode_frame(frame_of(msg))
        deadline = instant_after(self._clock.now(), timeout or 0.0)
        while True:
            try:
                self._socket.send(packet)
            except BlockingIOError:
                if not self._wait_for_room(deadline):
                    raise self._full() from None
            except OSError as error:
                self._lost(error)
            else:
                self._check_state()
                return

    def fileno(self) -> int:
        """The socket, for an event loop to watch; -1 once shut down."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Leave the hub; what was sent still goes out."""
        super().shutdown()
        self._socket.close()

    def _receive(self, until: Instant) -> Received | None:
        if self._kept:
            return self._kept.popleft()
        while True:
            try:
                packet = self._socket.recv(FRAME_BYTES)
            except BlockingIOError:
                remaining_ns = until - self._clock.now()
                if remaining_ns <= 0:
                    return None
                select.select([self._socket], [], [], min(remaining_ns / NS_PER_S, _WAIT_MAX_S))
                continue
            except OSError as error:
                self._lost(error)
            if not packet:
                self._lost(None)
            if len(packet) != FRAME_BYTES:
                self._note(packet)
                continue
            received = decode_frame(packet)
            if self._filters is None or accepts(self._filters, received.frame):
                return received

    def _note(self, packet: bytes) -> None:
        """Take in what the broker tells of this client's controller."""
        told = decode_status(packet)
        if told is None:
            raise can.CanOperationError(f"{self.channel_info}: the hub sent what is no frame")
        status, asked = told
        self._error_state = status.error_state
        if asked:
            self._answers.append(status)

    def _ask(self, request: Request) -> HubStatus:
        """The answer to ``request``; frames that come before it are kept, also if another thread reads."""
        try:
            self._socket.send(encode_request(request))
        except OSError as error:
            self._lost(error)
        deadline = instant_after(self._clock.now(), _ANSWER_MAX_S)
        while not self._answers:
            now = self._clock.now()
            if now >= deadline:
                raise can.CanOperationError(f"{self.channel_info}: the hub does not answer")
            try:
                packet = self._socket.recv(FRAME_BYTES)
            except BlockingIOError:
                select.select([self._socket], [], [], _ASK_AGAIN_S)
                continue
            except OSError as error:
                self._lost(error)
            if not packet:
                self._lost(None)
            if len(packet) != FRAME_BYTES:
                self._note(packet)
                continue
            received = decode_frame(packet)
            if self._filters is None or accepts(self._filters, received.frame):
                self._kept.append(received)
        return self._answers.popleft()

    def _check_state(self) -> None:
        """Raises can.CanOperationError if the controller is bus-off, as asked again once it was."""
        if self._error_state is ErrorState.BUS_OFF and self.status().error_state is ErrorState.BUS_OFF:
            raise can.CanOperationError(f"{self.channel_info}: the controller is bus-off")

    def _full(self) -> can.CanOperationError:
        return can.CanOperationError(f"{self.channel_info}: transmit queue is full", errno.ENOBUFS)

    def _wait_for_room(self, deadline: Instant) -> bool:
        remaining_ns = deadline - self._clock.now()
        if remaining_ns <= 0:
            return False
        select.select([], [self._socket], [], remaining_ns / NS_PER_S)
        return True

    def _lost(self, error: OSError | None) -> NoReturn:
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down") from error
        raise can.CanOperationError(
            f"{self.channel_info}: the hub is gone; its process ended, or it dropped this client for not"
            " taking its frames. Open the bus again"
        ) from error

    @staticmethod
    def _detect_available_configs() -> list[AutoDetectedConfig]:
        return [{"interface": "hub", "channel": name} for name in known_hubs()]
