"""A client's end of its connection to a hub: frames both ways, and requests to its controller."""

import errno
import select
import socket
from collections import deque
from typing import Final, NoReturn

import can
from can.typechecking import CanFilters

from servobench.drivers.timebase import NS_PER_S, Clock, Instant, instant_after
from servobench.drivers.wire.frame_port import EchoBasis, FramePort, accepts
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.hub_protocol import (
    FRAME_BYTES,
    PACKET_BYTES_MAX,
    HubStatus,
    Record,
    Request,
    decode_status,
    encode_frame,
    encode_request,
    frame_of,
    is_own,
    split_batch,
)
from servobench.virtual_bus.frame import Frame

_WAIT_MAX_S: Final = 3_600.0
"""Limit of one ``poll``, whose milliseconds are a C int; the wait continues after it."""
_SELECT_MAX: Final = 1024
"""FD_SETSIZE of <sys/select.h>; beyond it poll waits by the millisecond, and asks through the last one."""
_ANSWER_MAX_S: Final = 5.0
"""The broker answers at once; a process of a busy machine may be kept waiting for seconds."""
_ASK_AGAIN_S: Final = 0.01
"""Another thread that reads may have taken in the answer."""


class HubPort(FramePort):
    """``connection``: non-blocking, welcomed by the broker.

    All methods but :meth:`transmit` and :meth:`close` raise can.CanOperationError if the broker is gone.
    """

    def __init__(self, connection: socket.socket, name: str, clock: Clock, receive_own: bool) -> None:
        super().__init__()
        if receive_own:
            self.echoes = EchoBasis.BUS
        self.filters: CanFilters | None = None
        self.error_state = ErrorState.ACTIVE
        """The last state reported."""
        self._name = name
        self._socket = connection
        self._open = True
        self._now = clock.now
        self._kept: deque[Record] = deque()
        self._answers: deque[HubStatus] = deque()
        # select, as poll and epoll wait by the millisecond; poll where there is nothing to wait for, as it
        # takes half the time. An exception for an empty socket would take three times that.
        self._ready = [connection.fileno()]
        self._selects = connection.fileno() < _SELECT_MAX
        self._nobody: list[int] = []
        poller = select.poll()
        poller.register(connection, select.POLLIN)
        self._poll = poller.poll

    def receive(self, until: Instant) -> Frame | None:
        """The next frame; None at ``until`` (CLOCK_MONOTONIC)."""
        kept = self._kept
        while not kept:
            if not self._wait(until):
                return None
            self._take_in()
        at, handed_at, can_id, flags, dlc, data = kept.popleft()
        self.came_at = Instant(at)
        self.came_own = is_own(flags)
        return frame_of(handed_at, can_id, flags, dlc, data)

    def transmit(self, frame: Frame) -> None:
        """Hand ``frame`` to the hub. Raises can.CanOperationError if the queue is full or the broker gone."""
        try:
            self._socket.send(encode_frame(frame))
        except BlockingIOError:
            full = f"{self._name}: transmit queue is full"
            raise can.CanOperationError(full, errno.ENOBUFS) from None
        except OSError as error:
            self._lost(error)
        if self.error_state is ErrorState.BUS_OFF:
            self._check_state()

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
            if self._wait(min(deadline, instant_after(now, _ASK_AGAIN_S))):
                self._take_in()
        return self._answers.popleft()

    def close(self) -> None:
        """Leave; what was sent still goes out."""
        self._open = False
        self._socket.close()

    def _wait(self, until: Instant) -> bool:
        """Wait; return True if a packet arrives by ``until``."""
        if not self._open:
            self._lost(None)
        remaining_ns = until - self._now()
        if remaining_ns <= 0:
            return bool(self._poll(0))
        wait_s = min(remaining_ns / NS_PER_S, _WAIT_MAX_S)
        while not (
            select.select(self._ready, self._nobody, self._nobody, wait_s)[0]
            if self._selects
            else self._poll(int(wait_s * 1000.0))
        ):
            remaining_ns = until - self._now()
            if remaining_ns <= 0:
                return False
            wait_s = min(remaining_ns / NS_PER_S, _WAIT_MAX_S)
        return True

    def _take_in(self) -> None:
        """Read one packet; none is there if another thread was faster."""
        try:
            packet = self._socket.recv(PACKET_BYTES_MAX)
        except BlockingIOError:
            return
        except OSError as error:
            self._lost(error)
        if not packet:
            self._lost(None)
        if len(packet) % FRAME_BYTES:
            self._note(packet)
            return
        filters = self.filters
        if filters is None:
            self._kept.extend(split_batch(packet))
            return
        for record in split_batch(packet):
            if accepts(filters, frame_of(*record[1:])):
                self._kept.append(record)

    def _note(self, packet: bytes) -> None:
        """Take in what the broker tells of this client's controller."""
        decoded = decode_status(packet)
        if decoded is None:
            raise can.CanOperationError(f"{self._name}: the hub sent what is no frame")
        status, asked = decoded
        self.error_state = status.error_state
        if asked:
            self._answers.append(status)

    def _check_state(self) -> None:
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
