"""A client's end of its connection to a hub: frames both ways, and requests to its controller."""

import errno
import os
import socket
from collections import deque
from functools import partial
from typing import Final, NoReturn

import can
from can.typechecking import CanFilters

from servobench.drivers.timebase import Clock, Instant, instant_after
from servobench.drivers.wire.frame_port import EchoBasis, FramePort, accepts
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.hub_protocol import HubStatus, Request, decode_status, encode_request
from servobench.virtual_bus.core.native import HubEnd
from servobench.virtual_bus.frame import Frame

_ANSWER_MAX_S: Final = 5.0
"""The broker answers at once; a process of a busy machine may be kept waiting for seconds."""
_ASK_AGAIN_S: Final = 0.01
"""Another thread that reads may have taken in the answer."""


class HubPort(FramePort):
    """``connection``: non-blocking, welcomed by the broker. What is done for each frame is C
    (core/hub_end_type.c).

    All methods but :meth:`transmit` and :meth:`close` raise can.CanOperationError if the broker is gone.
    """

    def __init__(self, connection: socket.socket, name: str, clock: Clock, receive_own: bool) -> None:
        super().__init__()
        if receive_own:
            self.echoes = EchoBasis.BUS
        self.error_state = ErrorState.ACTIVE
        """The last state reported."""
        self._name = name
        self._socket = connection
        self._open = True
        self._now = clock.now
        self._end = HubEnd(connection.fileno(), self)
        self.native = self._end
        self._answers: deque[HubStatus] = deque()

    def filter(self, filters: CanFilters | None) -> None:
        """Let only those through that ``filters`` accept."""
        self._end.accepts = None if filters is None else partial(accepts, filters)

    def receive(self, until: Instant) -> Frame | None:
        """The next frame; None at ``until`` (CLOCK_MONOTONIC)."""
        received = self._end.receive(until)
        if received is None:
            return None
        frame, self.came_at, self.came_own = received
        return frame

    def transmit(self, frame: Frame) -> None:
        """Hand ``frame`` to the hub. Raises can.CanOperationError if the queue is full or the broker gone."""
        self._end.transmit(frame)

    def ask(self, request: Request) -> HubStatus:
        """The answer to ``request``; frames that come before it are kept, also if another thread reads."""
        try:
            self._socket.send(encode_request(request))
        except OSError as error:
            self._lost(error)
        deadline = instant_after(self._now(), _ANSWER_MAX_S)
        while not self._answers:
            now = self._now()
            if now >= deadline:
                raise can.CanOperationError(f"{self._name}: the hub does not answer")
            self._end.take_in(min(deadline, instant_after(now, _ASK_AGAIN_S)))
        return self._answers.popleft()

    def close(self) -> None:
        """Leave; what was sent still goes out."""
        self._open = False
        self._end.close()
        self._socket.close()

    def note(self, packet: bytes) -> None:
        """See :class:`servobench.virtual_bus.core.native.HubEndOwner`, as of the methods below; the broker
        tells of this client's controller."""
        decoded = decode_status(packet)
        if decoded is None:
            raise can.CanOperationError(f"{self._name}: the hub sent what is no frame")
        status, asked = decoded
        self.error_state = status.error_state
        self._end.bus_off = status.error_state is ErrorState.BUS_OFF
        if asked:
            self._answers.append(status)

    def failed(self, error: int) -> NoReturn:
        """Raises can.CanOperationError."""
        if error == errno.EAGAIN:
            raise can.CanOperationError(f"{self._name}: transmit queue is full", errno.ENOBUFS)
        self._lost(OSError(error, os.strerror(error)) if error else None)

    def check_state(self) -> None:
        """Raises can.CanOperationError if the controller is bus-off, as asked again once it was."""
        if self.ask(Request.STATUS).error_state is ErrorState.BUS_OFF:
            raise can.CanOperationError(f"{self._name}: the controller is bus-off")

    def _lost(self, error: OSError | None) -> NoReturn:
        if not self._open:
            raise can.CanOperationError(f"{self._name}: the bus is shut down") from error
        raise can.CanOperationError(
            f"{self._name}: the hub is gone; its process ended, or it dropped this client for not"
            " taking its frames. Open the bus again"
        ) from error
