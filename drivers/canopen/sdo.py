"""SDO client without a thread (CiA 301 7.2.4): python ``canopen``'s client, its queue replaced by a pump.

canopen's client and LSS master wait on a queue that another thread fills. Here :class:`AnswerQueue` replaces
that queue, and waiting on it lets the network handle frames until the answer or the deadline comes.

A bring-up is some hundred transfers of at most four bytes. Those, and uploads, go without canopen's streams,
which take longer than everything else in such a transfer.

Accounts of outstanding answers to requests and PDOs to SYNCs. Anything beyond them is unsolicited.
"""

import logging
import queue
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from struct import Struct
from typing import Any, Final, Protocol

from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from servobench.drivers.canopen.cob_ids import SDO_ANSWER, SDO_REQUEST
from servobench.drivers.timebase import NS_PER_S, Duration, Instant, duration_s

# canopen logs each repeated request as a warning. Whoever wants to read that sets up logging for it.
logger = logging.getLogger("canopen.sdo.client")
logging.getLogger("canopen").addHandler(logging.NullHandler())

SDO_ATTEMPTS = 6
"""Requests sent before a node is given up, and transfers begun before one that breaks off is: where one frame
in ten is lost, 41 % of those with five segments break off, six in a row 0.5 %."""

_HEADER = Struct("<BHB")
_ABORT_FRAME = Struct("<BHBL")
# First bytes of initiate download and upload, of their answers, and of an abort (CiA 301 7.2.4.3.3,
# 7.2.4.3.6, 7.2.4.3.17); the answer to an upload tells beside it how many bytes are unused.
_EXPEDITED_DOWNLOAD = 0x23
_INITIATE_UPLOAD = 0x40
_EXPEDITED, EXPEDITED_BYTES = 2, 4
ABORTED = 0x80
_UPLOAD_SEGMENT, _SEGMENT_MASK = 0x60, 0xE0
_TOGGLE, _LAST_SEGMENT = 0x10, 1
_NOT_ALTERNATED, _TIMED_OUT, _NO_COMMAND = _BROKEN_OFF = (0x05030000, 0x05040000, 0x05040001)
"""Toggle bit not alternated, timed out, command specifier not valid (CiA 301 table 22): a server's answers to
a segment requested again after a lost answer. They say nothing about the object."""
# Client command specifiers (CiA 301 7.2.4.3).
_INITIATE_DOWNLOAD = 1
_BLOCK_DOWNLOAD = 6
_INITIATE_ANSWERS = {_INITIATE_DOWNLOAD: 3, 2: 2}
"""Initiate download and initiate upload -> server command specifier of the answer, which names the object."""
_ABORT_ANSWER = ABORTED >> 5


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


def initiate_upload(index: int, sub: int) -> bytes:
    """Return the request that begins to read an object."""
    return _HEADER.pack(_INITIATE_UPLOAD, index, sub) + bytes(EXPEDITED_BYTES)


def expedited_download(index: int, sub: int, value: bytes) -> bytes:
    """Return the request that writes 1 to 4 bytes."""
    command = _EXPEDITED_DOWNLOAD | (EXPEDITED_BYTES - len(value)) << 2
    return _HEADER.pack(command, index, sub) + value.ljust(EXPEDITED_BYTES, b"\0")


def uploaded(answer: bytes) -> bytes:
    """Return the 1 to 4 bytes of the answer to an expedited upload."""
    unused = answer[0] >> 2 & 3 if answer[0] & 1 else 0
    return answer[4 : 8 - unused]


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
        answer = self.await_one(timeout if block else 0.0)
        if answer is None:
            raise queue.Empty
        return answer

    def await_one(self, timeout: float) -> bytes | None:
        """Return the next answer, None after ``timeout`` seconds without one."""
        deadline = self._pump.deadline_after(duration_s(timeout))
        while not self._answers:
            if not self._pump.pump_one(deadline) and not self._answers:
                return None
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
        return bytes(self._complete(partial(self._upload, index, subindex)))

    def download(self, index: int, subindex: int, data: bytes, force_segment: bool = False) -> None:
        """Write an object; start again if its segments break off."""
        if 1 <= len(data) <= EXPEDITED_BYTES and not force_segment:
            self.request_response(expedited_download(index, subindex, data))
        else:
            self._complete(partial(super().download, index, subindex, data, force_segment))

    def _upload(self, index: int, subindex: int) -> bytes:
        answer = self.request_response(initiate_upload(index, subindex))
        if answer[0] & _EXPEDITED:
            return uploaded(answer)
        data, toggle = bytearray(), 0
        while True:
            answer = self.request_response(bytes([_UPLOAD_SEGMENT | toggle]) + bytes(7))
            if answer[0] & _SEGMENT_MASK:
                self.abort(_NO_COMMAND)
                raise SdoCommunicationError(f"Unexpected response 0x{answer[0]:02X}")
            if answer[0] & _TOGGLE != toggle:
                self.abort(_NOT_ALTERNATED)
                raise SdoCommunicationError("Toggle bit mismatch")
            piece = answer[1 : 8 - (answer[0] >> 1 & 7)]
            data += piece
            if answer[0] & _LAST_SEGMENT or not piece:
                return bytes(data)
            toggle ^= _TOGGLE

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
        answers: AnswerQueue = self.responses
        answers.empty()
        self.busy = True
        try:
            for attempt in range(self.MAX_RETRIES):
                if attempt:
                    logger.warning("No SDO response received")
                self.send_request(sdo_request)
                answer = answers.await_one(self.RESPONSE_TIMEOUT)
                if answer is None:
                    continue
                if answer[0] == ABORTED:
                    code = int.from_bytes(answer[4:8], "little")
                    raise SdoAbortedError(code)
                return answer
        finally:
            self.busy = False
        self.abort(_TIMED_OUT)
        raise SdoCommunicationError("No SDO response received")

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
        self._pump.send_request(self._node_id, _ABORT_FRAME.pack(ABORTED, index, sub, abort_code))


ANSWER_LATE_MAX: Final = Duration(5 * NS_PER_S)
"""A node that stores its parameters, or is simulated on a busy machine, answers a second or two late."""
ANSWERS_DUE_MAX: Final = 1 << 15
"""More requests than a bus carries in that time: 3700 a second at 1 Mbit/s, two frames of 135 bits each."""

_ABORT_COMMAND: Final = 4
_BLOCKS: Final = (5, 6)
_NAMING_REQUESTS: Final = (1, 2, *_BLOCKS)
_NAMING_ANSWERS: Final = (2, 3, _ABORT_COMMAND)
"""Command specifiers of CiA 301 7.2.4.3: an abort, blocks either way, and those that initiate a transfer."""


class Owed:
    """An account of outstanding items.

    A late item never counts as surplus, unless it is later than ``due_max`` others; each lost one hides one
    surplus, up to ``due_max``.
    """

    __slots__ = ("due", "due_max", "surplus")

    def __init__(self, due_max: int) -> None:
        self.due = 0
        self.due_max = due_max
        """Items outstanding beyond this number count as lost."""
        self.surplus = 0
        """Items beyond those due, so far."""

    def expect(self, count: int = 1) -> None:
        """Add to the items due."""
        self.due = min(self.due + count, self.due_max)

    def came(self, count: int = 1) -> int:
        """Take in items; return how many were not due."""
        beyond = max(0, count - self.due)
        self.due = max(0, self.due - count)
        self.surplus += beyond
        return beyond


class OwedAnswers:
    """The answers that a node owes on its SDO channel: one per request, however often that was repeated.

    An answer that names an object is owed to a request that named it, an abort to any if none did. What has
    not come within ANSWER_LATE_MAX is taken for lost, and hides no surplus any more.

        asked     6041h  607Ch  segment      6040h
        came      6041h  607Ch  segment      6040h  6061h: nobody asked
    """

    __slots__ = ("_asked", "_blocks_until", "_earlier_until", "surplus")

    def __init__(self, now: Instant) -> None:
        """``now``: another client may have asked just before; its answer comes before any other."""
        self._asked: deque[tuple[Instant, bytes]] = deque(maxlen=ANSWERS_DUE_MAX)
        """Instant of each request, and the object that its answer must name; empty: none."""
        self._earlier_until = Instant(now + ANSWER_LATE_MAX)
        self._blocks_until = Instant(0)
        """Blocks of another client may pass until then: the answers due to them are not tracked."""
        self.surplus = 0
        """Answers beyond those due, so far."""

    def expect(self, asked_at: Instant, request: bytes) -> None:
        """Note one more answer due; none for an abort."""
        command = request[0] >> 5 if request else 0
        if command in _BLOCKS:
            self._blocks_until = Instant(asked_at + ANSWER_LATE_MAX)
        if command != _ABORT_COMMAND:
            named = command in _NAMING_REQUESTS
            self._asked.append((asked_at, request[1:4] if named else b""))

    def came(self, at: Instant, answer: bytes) -> bool:
        """Take in an answer; return True if it was due."""
        asked = self._asked
        while asked and at - asked[0][0] > ANSWER_LATE_MAX:
            asked.popleft()
        command = answer[0] >> 5 if answer else 0
        name = answer[1:4] if command in _NAMING_ANSWERS else b""
        due = next((each for each in asked if each[1] == name), None)
        if due is None and command == _ABORT_COMMAND and asked:
            due = asked[0]
        if due is not None:
            asked.remove(due)
            self._earlier_until = Instant(0)
            return True
        if at <= self._earlier_until:
            self._earlier_until = Instant(0)
            return True
        if at <= self._blocks_until:
            return True
        self.surplus += 1
        return False
