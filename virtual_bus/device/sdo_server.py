"""SDO server: expedited, segmented and block transfers of the dictionary (CiA 301, 7.2.4).

    ccs  request               answered by
    0    download segment      the running segmented download
    1    initiate download     expedited at once, or a new segmented download
    2    initiate upload       expedited at once, or a new segmented upload
    3    upload segment        the running segmented upload
    4    abort                 nobody; the running transfer is forgotten
    5    block upload          a new or the running block upload
    6    block download        a new or the running block download

An initiate request amid a transfer takes its place: the client has given the other up. Anything else
out of place is aborted with 05040001h. Messages that are not 8 bytes long are no SDOs and are ignored.

A transfer takes the client's requests one by one and returns the server's answers, each 8 bytes. Each kind is
a generator, in the order of the messages: it is sent a request, and yields what answers it. An error of the
client is an SdoAbort, which ends the transfer.

In a block transfer a sub-block of up to 127 segments is answered once, with the number of the last segment
that came in sequence; what follows that one is sent again. The CRC is CCITT, x^16 + x^12 + x^5 + 1, start
value 0.
"""

from binascii import crc_hqx
from collections.abc import Callable, Container, Generator, Sequence
from functools import partial

from servobench.drivers.canopen.cob_ids import SDO_ANSWER, SDO_REQUEST
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import SDO_SERVER
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.device.sdo_abort import AbortCode, SdoAbort, byte_length
from servobench.virtual_bus.device.station import Station
from servobench.virtual_bus.frame import Frame

Commit = Callable[[bytes], object]
"""Writes the received bytes into the dictionary. Error: SdoAbort."""
Steps = Generator[Sequence[bytes], bytes, Sequence[bytes]]
"""Is sent requests and yields the answers to each; what it returns answers the last."""

DOWNLOAD_MAX = 1 << 16
"""Bytes of the longest download that the device has memory for."""

SEGMENT_BYTES = 7


class Transfer:
    """A transfer that has been initiated."""

    def __init__(self, multiplexer: bytes, commands: Container[int], steps: Steps) -> None:
        """``multiplexer``: index and sub-index, 3 bytes as in the initiate message; an abort repeats them.
        ``commands``: first bytes of the requests that belong to it."""
        self.multiplexer = multiplexer
        self.commands = commands
        self.finished = False
        self._steps = steps
        next(steps)

    def answer(self, request: bytes) -> Sequence[bytes]:
        """The server's messages in answer to ``request``. Error: SdoAbort."""
        try:
            return self._steps.send(request)
        except StopIteration as end:
            self.finished = True
            answers: Sequence[bytes] = end.value
            return answers


def check_room(length: int) -> None:
    """Error: SdoAbort 05040005h."""
    if length > DOWNLOAD_MAX:
        raise SdoAbort(AbortCode.OUT_OF_MEMORY)


def _checked_length(data: bytes, size: int | None) -> bytes:
    if size is not None and len(data) != size:
        raise SdoAbort(AbortCode.LENGTH)
    return data


def segmented_download(multiplexer: bytes, size: int | None, commit: Commit) -> Transfer:
    """Client to server: ccs 0, 7 bytes a segment, toggle bit from 0 on. ``size``: bytes that the client
    announced, if it did."""

    def steps() -> Steps:
        toggle, data, answers = 0, bytearray(), list[bytes]()
        while True:
            request = yield answers
            command = request[0]
            if command & 0x10 != toggle:
                raise SdoAbort(AbortCode.TOGGLE_BIT)
            data += request[1 : 8 - (command >> 1 & 7)]
            check_room(len(data))
            if size is not None and len(data) > size:
                raise SdoAbort(AbortCode.LENGTH)
            answers = [bytes([0x20 | toggle, 0, 0, 0, 0, 0, 0, 0])]
            if command & 1:
                commit(_checked_length(bytes(data), size))
                return answers
            toggle ^= 0x10

    return Transfer(multiplexer, range(0x20), steps())


def segmented_upload(multiplexer: bytes, data: bytes) -> Transfer:
    """Server to client: ccs 3, 7 bytes a segment, toggle bit from 0 on."""

    def steps() -> Steps:
        toggle, answers = 0, list[bytes]()
        for start in range(0, max(len(data), 1), SEGMENT_BYTES):
            request = yield answers
            if request[0] & 0x10 != toggle:
                raise SdoAbort(AbortCode.TOGGLE_BIT)
            piece = data[start : start + SEGMENT_BYTES]
            last = start + SEGMENT_BYTES >= len(data)
            command = toggle | (SEGMENT_BYTES - len(piece)) << 1 | last
            answers = [bytes([command]) + piece.ljust(SEGMENT_BYTES, b"\x00")]
            toggle ^= 0x10
        return answers

    return Transfer(multiplexer, range(0x60, 0x80), steps())


BLOCK_SIZE_MAX = 127
LAST_SEGMENT = 0x80
ABORT_COMMAND = 0x80
_START, _RECEIVED, _END = 0xA3, 0xA2, 0xA1
"""Commands of the client of a block upload."""


def block_crc(data: bytes) -> int:
    """CRC of a block transfer's data."""
    return crc_hqx(data, 0)


def block_download(multiplexer: bytes, size: int | None, with_crc: bool, commit: Commit) -> Transfer:
    """Client to server: sub-blocks of segments (first byte: last flag and sequence number), then an end."""

    def steps() -> Steps:
        data, in_sequence, complete, answers = bytearray(), 0, False, list[bytes]()
        while not complete:
            request = yield answers
            number, last = request[0] & 0x7F, bool(request[0] & LAST_SEGMENT)
            if number == 0:
                raise SdoAbort(AbortCode.SEQUENCE_NUMBER)
            if number == in_sequence + 1:
                in_sequence, complete = number, last
                data += request[1:8]
                check_room(len(data) - SEGMENT_BYTES)
            answers = []
            if last or number == BLOCK_SIZE_MAX:
                answers = [bytes([0xA2, in_sequence, BLOCK_SIZE_MAX, 0, 0, 0, 0, 0])]
                in_sequence = 0
        transfer.commands = [command for command in range(0x100) if command & 0xE1 == 0xC1]
        request = yield answers
        received = _checked_length(bytes(data[: len(data) - (request[0] >> 2 & 7)]), size)
        if with_crc and int.from_bytes(request[1:3], "little") != block_crc(received):
            raise SdoAbort(AbortCode.CRC)
        commit(received)
        return [bytes([0xA1, 0, 0, 0, 0, 0, 0, 0])]

    # In a sub-block every first byte is a segment's; 80h (last segment, number 0) is an abort.
    transfer = Transfer(multiplexer, range(0x100), steps())
    return transfer


def block_upload(multiplexer: bytes, data: bytes, block_size: int, with_crc: bool) -> Transfer:
    """Server to client. ``block_size``: segments a sub-block. Error: SdoAbort 05040002h."""
    segments = max(1, -(-len(data) // SEGMENT_BYTES))  # empty data takes one as well

    def segment(number: int, position: int) -> bytes:
        piece = data[(position - 1) * SEGMENT_BYTES : position * SEGMENT_BYTES]
        last = LAST_SEGMENT if position == segments else 0
        return bytes([number | last]) + piece.ljust(SEGMENT_BYTES, b"\x00")

    def steps(size: int) -> Steps:
        _expect((yield ()), _START)
        acknowledged = 0
        while acknowledged < segments:
            in_flight = min(size, segments - acknowledged)
            request = yield [segment(number, acknowledged + number) for number in range(1, in_flight + 1)]
            _expect(request, _RECEIVED)
            if request[1] > in_flight:
                raise SdoAbort(AbortCode.SEQUENCE_NUMBER)
            size = _checked(request[2])
            acknowledged += request[1]
        unused = segments * SEGMENT_BYTES - len(data)
        crc = block_crc(data) if with_crc else 0
        _expect((yield [bytes([0xC1 | unused << 2]) + crc.to_bytes(2, "little") + bytes(5)]), _END)
        return ()

    commands = [command for command in range(0x100) if command & 0xE3 in (_START, _RECEIVED, _END)]
    return Transfer(multiplexer, commands, steps(_checked(block_size)))


def _expect(request: bytes, command: int) -> None:
    if request[0] & 0xE3 != command:
        raise SdoAbort(AbortCode.COMMAND_UNKNOWN)


def _checked(block_size: int) -> int:
    if not 1 <= block_size <= BLOCK_SIZE_MAX:
        raise SdoAbort(AbortCode.BLOCK_SIZE)
    return block_size


_SERVED_IN = frozenset({NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL})
_NO_MULTIPLEXER = bytes(3)
EXPEDITED_BYTES = 4
_TIMEOUT_NS = 3000 * NS_PER_MS
"""A transfer in which the client falls silent for that long is aborted (05040000h)."""


class SdoServer:
    """The default SDO server."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._transfer: Transfer | None = None
        self._request_id: int | None = None
        self._response_id = 0
        self._timer = station.timer(self._on_timeout)

    def reset_communication(self) -> None:
        """Take the COB-IDs from 1200h; a running transfer is gone."""
        if self._request_id is not None:
            self._station.ignore(self._request_id, self._on_frame)
        self._request_id = self._station.value(SDO_SERVER, 1) or SDO_REQUEST + self._station.node_id
        self._response_id = self._station.value(SDO_SERVER, 2) or SDO_ANSWER + self._station.node_id
        self._station.listen(self._request_id, self._on_frame)
        self._forget()

    def on_state(self, state: NmtState, _now: Instant) -> None:
        """SDOs exist in PRE-OPERATIONAL and OPERATIONAL only (CiA 301, table 38)."""
        if state not in _SERVED_IN:
            self._forget()

    def _on_frame(self, frame: Frame, now: Instant) -> None:
        request = frame.data
        if len(request) != 8 or self._station.state not in _SERVED_IN:
            return
        try:
            self._serve(request)
        except SdoAbort as abort:
            self._abort(abort.code, request)
        if self._transfer is not None:
            self._timer.start(Instant(now + _TIMEOUT_NS))

    def _serve(self, request: bytes) -> None:
        if request[0] == ABORT_COMMAND:
            self._forget()
            return
        transfer = self._transfer
        if transfer is not None and request[0] in transfer.commands:
            for answer in transfer.answer(request):
                self._send(answer)
            if transfer.finished:
                self._forget()
            return
        initiate = self._initiator(request[0])
        if initiate is None:
            raise SdoAbort(AbortCode.COMMAND_UNKNOWN)
        self._forget()
        initiate(request)

    def _initiator(self, command: int) -> Callable[[bytes], None] | None:
        specifier = command >> 5
        if specifier == 1:
            return self._initiate_download
        if specifier == 2:
            return self._initiate_upload
        if specifier == 5 and command & 3 == 0:
            return self._initiate_block_upload
        if specifier == 6 and command & 1 == 0:
            return self._initiate_block_download
        return None

    def _initiate_download(self, request: bytes) -> None:
        index, subindex = _multiplexed(request)
        variable = self._station.dictionary.find_writable(index, subindex)
        command = request[0]
        expedited, sized = command & 2, command & 1
        if expedited:
            length = EXPEDITED_BYTES - (command >> 2 & 3) if sized else _assumed_length(variable)
            self._commit(index, subindex)(request[4 : 4 + length])
        else:
            size = int.from_bytes(request[4:8], "little") if sized else None
            _check_announced(variable, size)
            self._transfer = segmented_download(request[1:4], size, self._commit(index, subindex))
        self._send(bytes([0x60]) + request[1:4] + bytes(4))

    def _initiate_upload(self, request: bytes) -> None:
        data = self._station.dictionary.upload(*_multiplexed(request))
        self._begin_upload(request[1:4], data)

    def _begin_upload(self, multiplexer: bytes, data: bytes) -> None:
        if 1 <= len(data) <= EXPEDITED_BYTES:
            command = 0x43 | (EXPEDITED_BYTES - len(data)) << 2
            self._send(bytes([command]) + multiplexer + data.ljust(EXPEDITED_BYTES, b"\x00"))
        else:
            self._transfer = segmented_upload(multiplexer, data)
            self._send(bytes([0x41]) + multiplexer + len(data).to_bytes(4, "little"))

    def _initiate_block_download(self, request: bytes) -> None:
        index, subindex = _multiplexed(request)
        variable = self._station.dictionary.find_writable(index, subindex)
        command = request[0]
        size = int.from_bytes(request[4:8], "little") if command & 2 else None
        _check_announced(variable, size)
        commit = self._commit(index, subindex)
        self._transfer = block_download(request[1:4], size, bool(command & 4), commit)
        # The server can do CRC, and takes 127 segments at once.
        self._send(bytes([0xA4]) + request[1:4] + bytes([BLOCK_SIZE_MAX, 0, 0, 0]))

    def _initiate_block_upload(self, request: bytes) -> None:
        data = self._station.dictionary.upload(*_multiplexed(request))
        block_size, switch_threshold = request[4], request[5]
        # 7.2.4.3.13: short data may go by the ordinary upload where the client allows it.
        if switch_threshold and len(data) <= switch_threshold:
            self._begin_upload(request[1:4], data)
            return
        self._transfer = block_upload(request[1:4], data, block_size, bool(request[0] & 4))
        # CRC supported, size indicated.
        self._send(bytes([0xC6]) + request[1:4] + len(data).to_bytes(4, "little"))

    def _commit(self, index: int, subindex: int) -> Commit:
        return partial(self._station.dictionary.download, index, subindex)

    def _send(self, data: bytes) -> None:
        self._station.send(Frame(self._response_id, data))

    def _abort(self, code: AbortCode, request: bytes | None) -> None:
        if self._transfer is not None:
            multiplexer = self._transfer.multiplexer
        elif request is not None and self._initiator(request[0]) is not None:
            multiplexer = request[1:4]
        else:
            multiplexer = _NO_MULTIPLEXER
        self._forget()
        self._send(bytes([ABORT_COMMAND]) + multiplexer + code.to_bytes(4, "little"))

    def _forget(self) -> None:
        self._transfer = None
        self._timer.stop()

    def _on_timeout(self, _now: Instant) -> None:
        self._abort(AbortCode.TIMED_OUT, None)


def _multiplexed(request: bytes) -> tuple[int, int]:
    return request[1] | request[2] << 8, request[3]


def _assumed_length(variable: Variable) -> int:
    """Bytes of an expedited download that does not tell its size."""
    length = byte_length(variable.data_type)
    return EXPEDITED_BYTES if length is None else min(length, EXPEDITED_BYTES)


def _check_announced(variable: Variable, size: int | None) -> None:
    """A size that cannot fit is refused before any data comes."""
    if size is None:
        return
    check_room(size)
    length = byte_length(variable.data_type)
    if length is not None and size != length:
        raise SdoAbort(AbortCode.TOO_LONG if size > length else AbortCode.TOO_SHORT)
