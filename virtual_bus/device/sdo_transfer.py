"""SDO transfers in more than one message, expedited left aside: segmented, both ways (CiA 301, 7.2.4.3).

A transfer takes the client's requests one by one and returns the server's answers, each 8 bytes.
An error of the client is an SdoAbort, which ends the transfer. Block transfers are in
:mod:`virtual_bus.device.sdo_block`.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from virtual_bus.device.sdo_abort import AbortCode, SdoAbort

Commit = Callable[[bytes], None]
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
