"""SDO transfers in more than one message: segmented and in blocks, both ways (CiA 301, 7.2.4.3).

A transfer takes the client's requests one by one and returns the server's answers, each 8 bytes.
An error of the client is an SdoAbort, which ends the transfer.

In a block transfer a sub-block of up to 127 segments is answered once, with the number of the last segment
that came in sequence; what follows that one is sent again. The CRC is CCITT, x^16 + x^12 + x^5 + 1, start
value 0.
"""

from binascii import crc_hqx
from collections.abc import Callable, Sequence
from typing import Protocol

from virtual_bus.device.sdo_abort import AbortCode, SdoAbort

Commit = Callable[[bytes], object]
"""Writes the received bytes into the dictionary. Error: SdoAbort."""

DOWNLOAD_MAX = 1 << 16
"""Bytes of the longest download that the device has memory for."""

SEGMENT_BYTES = 7


class Transfer(Protocol):
    """A transfer that has been initiated."""

    multiplexer: bytes
    """Index and sub-index, 3 bytes as in the initiate message; an abort repeats them."""
    finished: bool

    def accepts(self, request: bytes) -> bool:
        """Whether ``request`` belongs to this kind of transfer."""
        ...

    def answer(self, request: bytes) -> Sequence[bytes]:
        """The server's messages in answer to ``request``. Error: SdoAbort."""
        ...


def check_room(length: int) -> None:
    """Error: SdoAbort 05040005h."""
    if length > DOWNLOAD_MAX:
        raise SdoAbort(AbortCode.OUT_OF_MEMORY)


class SegmentedDownload:
    """Client to server: ccs 0, 7 bytes a segment, toggle bit from 0 on."""

    def __init__(self, multiplexer: bytes, size: int | None, commit: Commit) -> None:
        """``size``: bytes that the client announced, if it did."""
        self.multiplexer = multiplexer
        self.finished = False
        self._size = size
        self._commit = commit
        self._toggle = 0
        self._data = bytearray()

    def accepts(self, request: bytes) -> bool:
        return request[0] >> 5 == 0

    def answer(self, request: bytes) -> Sequence[bytes]:
        command = request[0]
        if command & 0x10 != self._toggle:
            raise SdoAbort(AbortCode.TOGGLE_BIT)
        self._data += request[1 : 8 - (command >> 1 & 7)]
        check_room(len(self._data))
        if self._size is not None and len(self._data) > self._size:
            raise SdoAbort(AbortCode.LENGTH)
        if command & 1:
            if self._size is not None and len(self._data) != self._size:
                raise SdoAbort(AbortCode.LENGTH)
            self._commit(bytes(self._data))
            self.finished = True
        answer = bytes([0x20 | self._toggle, 0, 0, 0, 0, 0, 0, 0])
        self._toggle ^= 0x10
        return (answer,)


class SegmentedUpload:
    """Server to client: ccs 3, 7 bytes a segment, toggle bit from 0 on."""

    def __init__(self, multiplexer: bytes, data: bytes) -> None:
        self.multiplexer = multiplexer
        self.finished = False
        self._data = data
        self._sent = 0
        self._toggle = 0

    def accepts(self, request: bytes) -> bool:
        return request[0] >> 5 == 3

    def answer(self, request: bytes) -> Sequence[bytes]:
        if request[0] & 0x10 != self._toggle:
            raise SdoAbort(AbortCode.TOGGLE_BIT)
        piece = self._data[self._sent : self._sent + SEGMENT_BYTES]
        self._sent += len(piece)
        self.finished = self._sent >= len(self._data)
        command = self._toggle | (SEGMENT_BYTES - len(piece)) << 1 | self.finished
        self._toggle ^= 0x10
        return (bytes([command]) + piece.ljust(SEGMENT_BYTES, b"\x00"),)


BLOCK_SIZE_MAX = 127
LAST_SEGMENT = 0x80
ABORT_COMMAND = 0x80


def block_crc(data: bytes) -> int:
    """CRC of a block transfer's data."""
    return crc_hqx(data, 0)


class BlockDownload:
    """Client to server: sub-blocks of segments (first byte: last flag and sequence number), then an end."""

    def __init__(self, multiplexer: bytes, size: int | None, with_crc: bool, commit: Commit) -> None:
        self.multiplexer = multiplexer
        self.finished = False
        self._size = size
        self._with_crc = with_crc
        self._commit = commit
        self._data = bytearray()
        self._in_sequence = 0
        self._complete = False

    def initiated(self) -> bytes:
        """The answer to the initiate request: the server can do CRC, and takes 127 segments at once."""
        return bytes([0xA4]) + self.multiplexer + bytes([BLOCK_SIZE_MAX, 0, 0, 0])

    def accepts(self, request: bytes) -> bool:
        # In a sub-block every first byte is a segment's; 80h (last segment, number 0) is an abort.
        return not self._complete or request[0] & 0xE1 == 0xC1

    def answer(self, request: bytes) -> Sequence[bytes]:
        return self._end(request) if self._complete else self._segment(request)

    def _segment(self, request: bytes) -> Sequence[bytes]:
        number, last = request[0] & 0x7F, bool(request[0] & LAST_SEGMENT)
        if number == 0:
            raise SdoAbort(AbortCode.SEQUENCE_NUMBER)
        if number == self._in_sequence + 1:
            self._in_sequence = number
            self._data += request[1:8]
            check_room(len(self._data) - SEGMENT_BYTES)
            self._complete = last
        if not last and number < BLOCK_SIZE_MAX:
            return ()
        answer = bytes([0xA2, self._in_sequence, BLOCK_SIZE_MAX, 0, 0, 0, 0, 0])
        self._in_sequence = 0
        return (answer,)

    def _end(self, request: bytes) -> Sequence[bytes]:
        unused = request[0] >> 2 & 7
        data = bytes(self._data[: len(self._data) - unused])
        if self._size is not None and len(data) != self._size:
            raise SdoAbort(AbortCode.LENGTH)
        if self._with_crc and int.from_bytes(request[1:3], "little") != block_crc(data):
            raise SdoAbort(AbortCode.CRC)
        self._commit(data)
        self.finished = True
        return (bytes([0xA1, 0, 0, 0, 0, 0, 0, 0]),)


class BlockUpload:
    """Server to client. Client's commands: A3h start, A2h sub-block received, A1h end received."""

    def __init__(self, multiplexer: bytes, data: bytes, block_size: int, with_crc: bool) -> None:
        """``block_size``: segments a sub-block. Error: SdoAbort 05040002h."""
        self.multiplexer = multiplexer
        self.finished = False
        self._data = data
        self._with_crc = with_crc
        self._block_size = _checked(block_size)
        self._acknowledged = 0
        self._in_flight = 0
        self._started = False
        self._ended = False

    def initiated(self) -> bytes:
        """The answer to the initiate request: CRC supported, size indicated."""
        return bytes([0xC6]) + self.multiplexer + len(self._data).to_bytes(4, "little")

    def accepts(self, request: bytes) -> bool:
        return request[0] & 0xE3 in (0xA1, 0xA2, 0xA3)

    def answer(self, request: bytes) -> Sequence[bytes]:
        command = request[0] & 3
        if command == 3 and not self._started:
            self._started = True
            return self._sub_block()
        if command == 2 and self._started and not self._ended:
            return self._on_received(request[1], request[2])
        if command == 1 and self._ended:
            self.finished = True
            return ()
        raise SdoAbort(AbortCode.COMMAND_UNKNOWN)

    @property
    def _segments(self) -> int:
        """Segments of the whole transfer; empty data takes one as well."""
        return max(1, -(-len(self._data) // SEGMENT_BYTES))

    def _on_received(self, in_sequence: int, block_size: int) -> Sequence[bytes]:
        if in_sequence > self._in_flight:
            raise SdoAbort(AbortCode.SEQUENCE_NUMBER)
        self._block_size = _checked(block_size)
        self._acknowledged += in_sequence
        if self._acknowledged == self._segments:
            self._ended = True
            return (self._end(),)
        return self._sub_block()

    def _sub_block(self) -> Sequence[bytes]:
        self._in_flight = min(self._block_size, self._segments - self._acknowledged)
        return [self._segment(number) for number in range(1, self._in_flight + 1)]

    def _segment(self, number: int) -> bytes:
        position = self._acknowledged + number
        piece = self._data[(position - 1) * SEGMENT_BYTES : position * SEGMENT_BYTES]
        last = LAST_SEGMENT if position == self._segments else 0
        return bytes([number | last]) + piece.ljust(SEGMENT_BYTES, b"\x00")

    def _end(self) -> bytes:
        unused = self._segments * SEGMENT_BYTES - len(self._data)
        crc = block_crc(self._data) if self._with_crc else 0
        return bytes([0xC1 | unused << 2]) + crc.to_bytes(2, "little") + bytes(5)


def _checked(block_size: int) -> int:
    if not 1 <= block_size <= BLOCK_SIZE_MAX:
        raise SdoAbort(AbortCode.BLOCK_SIZE)
    return block_size
