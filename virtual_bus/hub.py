"""python-can's view of a hub: a CAN bus in real time between the processes of one user.

``can.Bus(interface="hub", channel="bench", bitrate=1_000_000)``. The first to join starts
the hub's broker (virtual_bus.can_bus.hub_broker), which leaves after the last one.
"""

import select
from typing import NoReturn

import can
from can.typechecking import AutoDetectedConfig, CanFilters

from drivers.timebase import NS_PER_S, Instant, MonotonicClock, instant_after
from virtual_bus.can_bus.filters import accepts
from virtual_bus.can_bus.hub_join import join
from virtual_bus.can_bus.hub_place import HubPlace, known_hubs
from virtual_bus.can_bus.hub_protocol import FRAME_BYTES, Hello, Received, decode_frame, encode_frame
from virtual_bus.can_bus.message import frame_of, message_of
from virtual_bus.frame import Frame

_WAIT_MAX_S = 3_600.0
_NEVER = Instant(1 << 62)


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
        **_: object,
    ) -> None:
        """Join, and start the hub if it is not there.

        ``bitrate`` in bit/s; None joins at whatever the hub runs at, and starts it at 1 Mbit/s.
        Raises can.CanInitializationError for a bad name, another bit rate than the hub's, and
        a hub that does not start or answer.
        """
        self._clock = MonotonicClock()
        place = HubPlace(str(channel))
        self._socket, self.bitrate_bit_s = join(place, Hello(bitrate or 0, receive_own_messages), self._clock)
        self.channel_info = f"hub:{channel}"
        self._channel = str(channel)
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
            raise can.CanOperationError(f"{self.channel_info}: transmit queue is full") from None
        except OSError as error:
            self._lost(error)

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
                    raise can.CanOperationError(f"{self.channel_info}: transmit queue is full") from None
            except OSError as error:
                self._lost(error)
            else:
                return

    def fileno(self) -> int:
        """The socket, for an event loop to watch; -1 once shut down."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Leave the hub; what was sent still goes out."""
        super().shutdown()
        self._socket.close()

    def _receive(self, until: Instant) -> Received | None:
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
            received = decode_frame(packet)
            if self._filters is None or accepts(self._filters, received.frame):
                return received

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
