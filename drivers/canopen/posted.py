"""Transfers by SDO that go on while the caller does other things, one at a time (CiA 301 7.2.4)."""

from collections import deque
from collections.abc import Callable

from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.canopen.sdo import (
    ABORTED,
    EXPEDITED_BYTES,
    abort_text,
    expedited_download,
    initiate_upload,
    uploaded,
)
from servobench.drivers.errors import NoAnswer, PeerFault, TransferAborted
from servobench.drivers.timebase import Duration, Instant

_DOWNLOADED = 0x60
_EXPEDITED_MASK, _EXPEDITED_UPLOAD = 0xF2, 0x42
"""First bytes of the answers to a download and to an expedited upload, which tells beside it how many bytes
are unused (CiA 301 7.2.4.3.3, 7.2.4.3.6)."""


class PostedTransfer:
    """A confirmed expedited transfer that goes on while the caller does other things."""

    __slots__ = ("attempts", "deadline", "done_at", "failure", "frame", "index", "node_id", "sub")
    action = ""
    """A verb for errors."""

    def __init__(self, node_id: int, index: int, sub: int, frame: bytes) -> None:
        self.node_id, self.index, self.sub = node_id, index, sub
        self.frame = frame
        self.attempts = 0
        self.deadline = Instant(0)
        self.done_at: Instant | None = None
        """When the node confirmed it, or it was given up."""
        self.failure: PeerFault | None = None
        """Why it was given up."""

    @property
    def object(self) -> tuple[int, int, int]:
        """The action, and the index and sub-index of its object."""
        return self.frame[0] >> 5, self.index, self.sub

    def confirmed(self, data: bytes, at: Instant) -> bool:
        """Take an answer that names the object; False if it does not confirm this transfer."""
        raise NotImplementedError


class PostedDownload(PostedTransfer):
    """A posted write of 1 to 4 bytes."""

    __slots__ = ("value",)
    action = "write"

    def __init__(self, node_id: int, index: int, sub: int, value: bytes) -> None:
        if not 1 <= len(value) <= EXPEDITED_BYTES:
            raise ValueError(f"an expedited download carries 1 to 4 bytes, not {len(value)}")
        super().__init__(node_id, index, sub, expedited_download(index, sub, value))
        self.value = value

    def confirmed(self, data: bytes, at: Instant) -> bool:  # noqa: ARG002
        return data[0] == _DOWNLOADED


class PostedUpload(PostedTransfer):
    """A posted read; ``told`` is called with the bytes and the instant of their frame.

    A node that answers by segments counts as not answering.
    """

    __slots__ = ("_told",)
    action = "read"

    def __init__(self, node_id: int, index: int, sub: int, told: Callable[[bytes, Instant], None]) -> None:
        super().__init__(node_id, index, sub, initiate_upload(index, sub))
        self._told = told

    def confirmed(self, data: bytes, at: Instant) -> bool:
        if data[0] & _EXPEDITED_MASK != _EXPEDITED_UPLOAD:
            return False
        self._told(uploaded(data), at)
        return True


class TransferPost:
    """Posted transfers with a node, one at a time and in order (CiA 301 7.2.4: one transfer per channel)."""

    ATTEMPTS = 5
    """On a bus that loses one frame in ten, request or answer are lost 19 times in 100, five times in a row
    once in 4000."""
    TIMEOUT_NS = Duration(20_000_000)
    """Wait for the confirmation of one attempt."""
    WAITING_MAX = 64
    """Transfers to different objects, as one to the same object replaces the other: nobody writes as many
    without waiting, unless none is confirmed."""

    def __init__(self, node_id: int, send: Callable[[bytes], Instant]) -> None:
        """``send`` hands a request to the bus, and returns the instant."""
        self.in_flight: PostedTransfer | None = None
        self._node_id = node_id
        self._send = send
        self._waiting: deque[PostedTransfer] = deque()

    def post(self, transfer: PostedTransfer) -> None:
        """Send it when its turn comes; it replaces a waiting one to the same object.

        Raises NoAnswer when 64 wait, because the node then confirms none.
        """
        for place, other in enumerate(self._waiting):
            if other.object == transfer.object:
                self._waiting[place] = transfer
                return
        if len(self._waiting) >= self.WAITING_MAX:
            evidence = f"{self.WAITING_MAX} are waiting"
            raise NoAnswer(f"node {self._node_id} confirms no SDO transfer", evidence)
        self._waiting.append(transfer)
        if self.in_flight is None:
            self._next()

    def answered(self, data: bytes, at: Instant) -> bool:
        """Take the answer to the transfer in flight; False if this is the answer to something else."""
        transfer = self.in_flight
        if transfer is None or len(data) != 8 or data[1:4] != transfer.frame[1:4]:
            return False
        if data[0] == ABORTED:
            name = object_name(transfer.index, transfer.sub)
            code = int.from_bytes(data[4:8], "little")
            summary = f"node {self._node_id} refused to {transfer.action} {name}"
            self._finish(at, TransferAborted(summary, abort_text(code), code=code))
            return True
        if not transfer.confirmed(data, at):
            return False
        self._finish(at, None)
        return True

    def expire(self, now: Instant) -> None:
        """Send the transfer in flight again, or give it up, if its deadline has come."""
        transfer = self.in_flight
        if transfer is None or now < transfer.deadline:
            return
        if transfer.attempts < self.ATTEMPTS:
            self._transmit(transfer)
            return
        name = object_name(transfer.index, transfer.sub)
        evidence = f"{transfer.attempts} requests in {self.ATTEMPTS * self.TIMEOUT_NS / 1e6:.0f} ms"
        summary = f"node {self._node_id} did not confirm the {transfer.action} of {name}"
        self._finish(now, NoAnswer(summary, evidence))

    def _finish(self, at: Instant, failure: PeerFault | None) -> None:
        assert self.in_flight is not None
        self.in_flight.done_at, self.in_flight.failure = at, failure
        self.in_flight = None
        self._next()

    def _next(self) -> None:
        if self._waiting:
            self.in_flight = self._waiting.popleft()
            self._transmit(self.in_flight)

    def _transmit(self, transfer: PostedTransfer) -> None:
        transfer.attempts += 1
        sent_at = self._send(transfer.frame)
        transfer.deadline = Instant(sent_at + self.TIMEOUT_NS)
