"""SDO client without a thread (CiA 301 7.2.4): python ``canopen``'s client, its queue replaced by a pump.

canopen's client and LSS master wait on a queue that another thread fills. Here :class:`AnswerQueue` replaces
that queue, and waiting on it lets the network handle frames until the answer or the deadline comes.
"""

import logging
import queue
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from struct import Struct
from typing import Any, Protocol

from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from servobench.drivers.canopen.cob_ids import SDO_ANSWER, SDO_REQUEST
from servobench.drivers.canopen.owed import OwedAnswers
from servobench.drivers.errors import NoAnswer, PeerFault, TransferAborted
from servobench.drivers.timebase import Duration, Instant, duration_s

# canopen logs each repeated request as a warning. Whoever wants to read that sets up logging for it.
logging.getLogger("canopen").addHandler(logging.NullHandler())

SDO_ATTEMPTS = 6
"""Requests sent before a node is given up, and transfers begun before one that breaks off is: where one frame
in ten is lost, 41 % of those with five segments break off, six in a row 0.5 %."""

_HEADER = Struct("<BHB")
_ABORT = Struct("<BHBL")
# First bytes of initiate download and upload, of their answers, and of an abort (CiA 301 7.2.4.3.3,
# 7.2.4.3.6, 7.2.4.3.17); the answer to an upload tells beside it how many bytes are unused.
_EXPEDITED_DOWNLOAD = 0x23
_DOWNLOADED = 0x60
_INITIATE_UPLOAD = 0x40
_EXPEDITED_MASK, _EXPEDITED_UPLOAD = 0xF2, 0x42
_ABORTED = 0x80
_BROKEN_OFF = (0x05030000, 0x05040000, 0x05040001)
"""Toggle bit not alternated, timed out, command specifier not valid (CiA 301 table 22): a server's answers to
a segment requested again after a lost answer. They say nothing about the object."""
# Client command specifiers (CiA 301 7.2.4.3).
_INITIATE_DOWNLOAD = 1
_BLOCK_DOWNLOAD = 6
_INITIATE_ANSWERS = {_INITIATE_DOWNLOAD: 3, 2: 2}
"""Initiate download and initiate upload -> server command specifier of the answer, which names the object."""
_ABORT_ANSWER = _ABORTED >> 5


class Pump(Protocol):
    """The network as a waiting SDO client sees it."""

    def pump_one(self, until: Instant) -> bool:
        """Handle one frame; False once ``until`` has come."""
        ...

    def deadline_after(self, duration: Duration) -> Instant:
        """Return the instant ``duration`` from now."""
        ...

    def send_request(self, node_id: int, request: bytes) -> Instant:
        """Send one SDO request; raises UnlistedWrite first if it is not allowed."""
        ...


def written_object(request: bytes) -> tuple[int, int] | None:
    """Return index and sub-index of the object whose download a request initiates; None for any other
    request.

    Raises ValueError for a block download (CiA 301 7.2.4.3.9): this master sends none, and the segments of
    one, which begin with their number, could not be told from requests.
    """
    specifier = request[0] >> 5
    if specifier == _BLOCK_DOWNLOAD:
        raise ValueError("this master sends no SDO block downloads")
    return (request[1] | request[2] << 8, request[3]) if specifier == _INITIATE_DOWNLOAD else None


def object_name(index: int, sub: int) -> str:
    """``6040h:00``."""
    return f"{index:04X}h:{sub:02X}"


def abort_text(code: int) -> str:
    """Return an abort code with the standard's text, CiA 301 table 22."""
    return f"abort code {code:08X}h ({SdoAbortedError.CODES.get(code, 'not in the standard')})"


class AnswerQueue:
    """The part of ``queue.Queue`` that canopen uses; ``get`` pumps the network instead of blocking."""

    def __init__(self, pump: Pump) -> None:
        self._pump = pump
        self._answers: deque[bytes] = deque(maxlen=1024)

    def put(self, answer: bytes) -> None:
        """Keep an answer; the oldest is dropped when 1024 wait."""
        self._answers.append(answer)

    def empty(self) -> bool:
        """Drop leftovers of an earlier exchange. (canopen calls this only to discard a stale queue.)"""
        self._answers.clear()
        return True

    def get(self, block: bool = True, timeout: float = 0.0) -> bytes:
        """Return the next answer; raises ``queue.Empty`` after ``timeout`` seconds on the bench's clock."""
        deadline = self._pump.deadline_after(duration_s(timeout if block else 0.0))
        while not self._answers:
            if not self._pump.pump_one(deadline) and not self._answers:
                raise queue.Empty
        return self._answers.popleft()


class BrokenOff(SdoCommunicationError):
    """The segments of a transfer were lost again and again."""


class PumpedSdoClient(SdoClient):
    """canopen's SDO client on the default channel of one node, waiting by pumping."""

    def __init__(self, pump: Pump, node_id: int) -> None:
        super().__init__(SDO_REQUEST + node_id, SDO_ANSWER + node_id, ObjectDictionary())  # type: ignore[no-untyped-call]
        self._pump = pump
        self._node_id = node_id
        self.responses: Any = AnswerQueue(pump)
        self.answers = OwedAnswers(pump.deadline_after(Duration(0)))
        """Answers due from the node on this channel, to posted downloads and to other clients' requests
        too."""
        self.foreign_requests = 0
        """Requests of another client on this channel."""
        self.busy = False
        """True while a request waits for its answer, or for the channel: nothing else may begin on it."""
        self._multiplexer = bytes(3)
        self._answered_by: int | None = None
        """First octet expected in the answer to the present request; None: a segment was requested."""

    def upload(self, index: int, subindex: int) -> bytes:
        """Read an object; start again if its segments break off."""
        return bytes(self._complete(partial(super().upload, index, subindex)))

    def download(self, index: int, subindex: int, data: bytes, force_segment: bool = False) -> None:
        """Write an object; start again if its segments break off."""
        self._complete(partial(super().download, index, subindex, data, force_segment))

    def _complete(self, transfer: Callable[[], Any]) -> Any:
        code = 0
        for _ in range(SDO_ATTEMPTS):
            try:
                return transfer()
            except SdoAbortedError as error:
                if self._answered_by is not None or error.code not in _BROKEN_OFF:
                    raise
                code = error.code
        raise BrokenOff(f"its segments broke off {SDO_ATTEMPTS} times: {abort_text(code)}")

    def request_response(self, sdo_request: bytes) -> Any:
        """Send a request and return its answer; resend it when no answer comes."""
        self._answered_by = _INITIATE_ANSWERS.get(sdo_request[0] >> 5)
        if self._answered_by is not None:
            self._multiplexer = bytes(sdo_request[1:4])
        with self.taken():
            return super().request_response(sdo_request)  # type: ignore[no-untyped-call]

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Reserve the channel: polls wait."""
        self.busy = True
        try:
            yield
        finally:
            self.busy = False

    def send_request(self, sdo_request: bytes) -> None:
        """Send a request, or a segment of one: each has one answer."""
        request = bytes(sdo_request)
        self.answers.expect(self._pump.send_request(self._node_id, request), request)

    def on_foreign_request(self, data: bytes, at: Instant) -> None:
        """Note a request of another client to the node: its answer will be heard here."""
        self.foreign_requests += 1
        self.answers.expect(at, data)

    def on_answer(self, data: bytes) -> None:
        """Take an answer, unless it is malformed or belongs to a request given up before."""
        if len(data) != 8:
            return
        answer = data[0] >> 5
        if self._answered_by is None:
            fits = answer not in _INITIATE_ANSWERS.values()
        else:
            fits = data[1:4] == self._multiplexer and answer in (self._answered_by, _ABORT_ANSWER)
        if fits:
            self.responses.put(bytes(data))

    def abort(self, abort_code: int = 0x08000000) -> None:
        """Abort the transfer, naming its object as CiA 301 7.2.4.3.17 asks."""
        index, sub = self._multiplexer[0] | self._multiplexer[1] << 8, self._multiplexer[2]
        self._pump.send_request(self._node_id, _ABORT.pack(_ABORTED, index, sub, abort_code))


class PostedTransfer:
    """A confirmed expedited transfer that goes on while the caller does other things."""

    __slots__ = ("attempts", "deadline", "done_at", "failure", "frame", "index", "node_id", "sub")
    action = ""
    """A verb for errors."""

    def __init__(self, node_id: int, index: int, sub: int, command: int, value: bytes = b"") -> None:
        self.node_id, self.index, self.sub = node_id, index, sub
        self.frame = _HEADER.pack(command, index, sub) + value.ljust(4, b"\0")
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
        if not 1 <= len(value) <= 4:
            raise ValueError(f"an expedited download carries 1 to 4 bytes, not {len(value)}")
        super().__init__(node_id, index, sub, _EXPEDITED_DOWNLOAD | (4 - len(value)) << 2, value)
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
        super().__init__(node_id, index, sub, _INITIATE_UPLOAD)
        self._told = told

    def confirmed(self, data: bytes, at: Instant) -> bool:
        if data[0] & _EXPEDITED_MASK != _EXPEDITED_UPLOAD:
            return False
        unused = data[0] >> 2 & 3 if data[0] & 1 else 0
        self._told(bytes(data[4 : 8 - unused]), at)
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
        if data[0] == _ABORTED:
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
