"""SDO transfers in more than one message: segmented and in blocks, both ways (CiA 301, 7.2.4.3).

A transfer takes the client's requests one by one and returns the server's answers, each 8 bytes. Each kind is
a generator, in the order of the messages: it is sent a request, and yields what answers it. An error of the
client is an SdoAbort, which ends the transfer.

In a block transfer a sub-block of up to 127 segments is answered once, with the number of the last segment
that came in sequence; what follows that one is sent again. The CRC is CCITT, x^16 + x^12 + x^5 + 1, start
value 0.
"""

from binascii import crc_hqx
from collections.abc import Callable, Container, Generator, Sequence

from servobench.virtual_bus.device.sdo_abort import AbortCode, SdoAbort

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
