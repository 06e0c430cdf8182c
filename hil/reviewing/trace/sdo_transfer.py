"""SDO transfers put together from their frames: expedited, segmented and block (CiA 301 7.2.4).

One channel carries one transfer at a time. A transfer is told where it ends: confirmed, aborted, given up for
another one, or cut off by the end of the log.
"""

from binascii import crc_hqx
from dataclasses import dataclass, field
from typing import Final

from servobench.hil.reviewing.trace.frame_columns import LogFrame

KEPT_MAX: Final = 1 << 20
"""Bytes of a transfer that are kept, so that no log fills the memory; a firmware file may be longer."""
_SEGMENT: Final = 7
_ABORT: Final = 0x80
_LAST: Final = 0x80
"""Flag of a block's last segment; 1 to 127 in the other bits are its number."""


@dataclass(slots=True)
class SdoTransfer:
    """A transfer, whole or as far as it came."""

    index: int
    sub: int
    download: bool
    """The client writes."""
    first: LogFrame
    last: LogFrame
    frames: int = 0
    kind: str = "expedited"
    """expedited, segmented or block."""
    data: bytearray = field(default_factory=bytearray)
    length: int = 0
    """Bytes that came; more than ``data`` has where KEPT_MAX was not enough."""
    announced: int | None = None
    """Bytes that were to come, if that was told."""
    abort_code: int | None = None
    aborted_by: str = ""
    """client or server."""
    finished: bool = False
    asked: int = 1
    """How often it was asked for."""
    notes: list[str] = field(default_factory=list)
    """Irregularities of the transfer."""

    def add(self, piece: bytes) -> None:
        """Bytes that came, in their order."""
        self.length += len(piece)
        self.data += piece[: max(0, KEPT_MAX - len(self.data))]

    def drop(self, count: int) -> None:
        """The last ``count`` bytes were padding."""
        self.length -= count
        del self.data[self.length :]

    @property
    def whole(self) -> bool:
        """All its bytes are here."""
        return self.finished and self.length == len(self.data) and not self.notes


class SdoChannel:
    """The transfers between one server and its client, frame by frame."""

    def __init__(self) -> None:
        self._open: SdoTransfer | None = None
        self._segment_before: bytes | None = None
        """The frame of the segment that came last."""
        self._block: dict[int, bytes] | None = None
        """Segments of the sub-block that is under way, by number; None: none is."""
        self._last_number = 0
        """Number of the block's last segment, in its sub-block; 0 while it has not come."""
        self._seen_last = False
        self._crc = [False, False]
        """Flags: the client, the server computes a CRC."""
        self._complete = True
        """No segment of the transfer is missing in the log."""

    @property
    def pending(self) -> SdoTransfer | None:
        """The transfer that has not ended."""
        return self._open

    def take(self, frame: LogFrame, answered: bool) -> list[SdoTransfer]:
        """A frame of the client, or of the server if it is an answer; the transfers that end with it."""
        data, transfer = frame.data, self._open
        sends = transfer is not None and transfer.download != answered
        """True if the frame comes from the side that has the value."""
        if self._block is not None and sends and data and data[0] != _ABORT:
            return self._block_segment(frame)
        if len(data) < 8:
            self._count(frame)
            return []
        command = data[0] >> 5
        if not answered and (
            command in (1, 2) or (command == 5 and data[0] & 3 == 0) or (command == 6 and not data[0] & 1)
        ):
            return self._begin(frame, command)
        foreign = transfer is None or (command in (2, 3) and _object(data) != (transfer.index, transfer.sub))
        if answered and foreign:
            return self._unasked(frame)
        self._count(frame)
        if transfer is None:
            return []
        if command == 4:
            transfer.abort_code, transfer.aborted_by = _size(data), "server" if answered else "client"
            return self.close()
        if answered and command in (1, 2, 3):
            return self._answered(transfer, data)
        return self._sent(transfer, data) if sends else self._received(transfer, data)

    def close(self) -> list[SdoTransfer]:
        """The log ends: what has not ended."""
        transfer, self._open, self._block = self._open, None, None
        return [] if transfer is None else [transfer]

    # ---- beginnings and ends --------------------------------------------------------------------------

    def _begin(self, frame: LogFrame, command: int) -> list[SdoTransfer]:
        data, before = frame.data, self._open
        if before is not None and before.frames == before.asked and before.first.data == data:
            before.asked += 1
            self._count(frame)
            return []
        ended = self.close()
        index, sub = _object(data)
        transfer = SdoTransfer(index, sub, command in (1, 6), frame, frame, frames=1)
        self._open, self._segment_before, self._seen_last, self._complete = transfer, None, False, True
        if command == 1:
            _initiate(transfer, data)
        elif command in (5, 6):
            transfer.kind, self._crc = "block", [bool(data[0] & 4), False]
            transfer.announced = _size(data) if command == 6 and data[0] & 2 else None
        return ended

    def _count(self, frame: LogFrame) -> None:
        if self._open is not None:
            self._open.frames += 1
            self._open.last = frame

    def _end(self, transfer: SdoTransfer) -> list[SdoTransfer]:
        transfer.finished = True
        if not self._complete:
            transfer.notes.append("segments are missing")
        elif transfer.announced is not None and transfer.announced != transfer.length:
            transfer.notes.append(f"{transfer.announced} bytes were announced, {transfer.length} came")
        return self.close()

    def _unasked(self, frame: LogFrame) -> list[SdoTransfer]:
        """An answer to what nobody has asked: answered twice, or asked before the log begins."""
        data, command = frame.data, frame.data[0] >> 5
        if command not in (2, 3, 4):
            return []
        index, sub = _object(data)
        transfer = SdoTransfer(index, sub, command == 3, frame, frame, frames=1)
        transfer.notes.append("nobody is seen to ask")
        if command == 4:
            transfer.abort_code, transfer.aborted_by = _size(data), "server"
        elif command == 2 and data[0] & 2:
            transfer.add(_expedited(data))
            transfer.finished = True
        return [transfer]

    def _answered(self, transfer: SdoTransfer, data: bytes) -> list[SdoTransfer]:
        """To an initiate frame or to a segment of a download."""
        command = data[0] >> 5
        if command == 2 and not transfer.download:
            _initiate(transfer, data)
        ends = (
            {1: self._seen_last, 3: transfer.kind == "expedited"} if transfer.download else {2: data[0] & 2}
        )
        return self._end(transfer) if ends.get(command) else []

    # ---- segments and blocks --------------------------------------------------------------------------

    def _sent(self, transfer: SdoTransfer, data: bytes) -> list[SdoTransfer]:
        """A segment, the server's beginning of a block upload, or the end of a block's data."""
        command = data[0] >> 5
        if command == 0:
            return self._segment(transfer, data)
        if command == 6 and data[0] & 1:
            self._end_of_data(transfer, data)
        elif command == 6:
            self._crc[1] = bool(data[0] & 4)
            transfer.announced = _size(data) if data[0] & 2 else None
        return []

    def _received(self, transfer: SdoTransfer, data: bytes) -> list[SdoTransfer]:
        """Handle a frame of a block transfer: it may begin, a sub-block has come, or all of it."""
        command, step = data[0] >> 5, data[0] & 3
        if command != 5:
            return []
        if step == (0 if transfer.download else 3):
            if transfer.download:
                self._crc[1] = bool(data[0] & 4)
            self._block, self._last_number = {}, 0
        elif step == 2:
            self._acknowledged(transfer, data[1])
        return self._end(transfer) if step == 1 else []

    def _segment(self, transfer: SdoTransfer, data: bytes) -> list[SdoTransfer]:
        """Handle a segment of a segmented transfer, from whichever side.

        The toggle bit alternates from 0 on: the same frame is sent again, another one with the same bit
        follows one that is missing.
        """
        before = self._segment_before
        if self._seen_last or data == before:
            return []
        self._complete &= _toggle(data) == (0 if before is None else 1 - _toggle(before))
        self._segment_before = data
        transfer.add(data[1 : 1 + _SEGMENT - (data[0] >> 1 & 7)])
        self._seen_last = bool(data[0] & 1)
        return self._end(transfer) if self._seen_last and not transfer.download else []

    def _block_segment(self, frame: LogFrame) -> list[SdoTransfer]:
        """Handle a segment of the sub-block under way; it counts once it is acknowledged."""
        self._count(frame)
        assert self._block is not None
        number = frame.data[0] & 0x7F
        self._block[number] = frame.data[1:8]
        if frame.data[0] & _LAST:
            self._last_number = number
        return []

    def _acknowledged(self, transfer: SdoTransfer, count: int) -> None:
        """So many segments of the sub-block have come; the others will be sent again."""
        block = self._block
        if block is None:
            return
        for number in range(1, count + 1):
            self._complete &= number in block
            transfer.add(block.get(number, b""))
        self._block = None if 0 < self._last_number <= count else {}
        self._last_number = 0

    def _end_of_data(self, transfer: SdoTransfer, data: bytes) -> None:
        """How many bytes of the last segment are none, and the CRC of all."""
        if transfer.kind != "block" or self._seen_last:
            return
        self._seen_last = True
        transfer.drop(min(data[0] >> 2 & 7, transfer.length))
        told = int.from_bytes(data[1:3], "little")
        if all(self._crc) and self._complete and transfer.length == len(transfer.data):
            reckoned = crc_hqx(bytes(transfer.data), 0)  # CiA 301 7.2.4.3.16: x^16 + x^12 + x^5 + 1, from 0
            if reckoned != told:
                transfer.notes.append(f"its CRC is {told:04X}h, that of the data {reckoned:04X}h")


def _object(data: bytes) -> tuple[int, int]:
    """Index and sub-index that a frame names."""
    return data[1] | data[2] << 8, data[3]


def _size(data: bytes) -> int:
    """The UNSIGNED32 behind the object."""
    return int.from_bytes(data[4:8], "little")


def _initiate(transfer: SdoTransfer, data: bytes) -> None:
    """The value itself, or how long it will be."""
    if data[0] & 2:
        transfer.kind = "expedited"
        transfer.add(_expedited(data))
    else:
        transfer.kind = "segmented"
        transfer.announced = _size(data) if data[0] & 1 else None


def _toggle(segment: bytes) -> int:
    return segment[0] >> 4 & 1


def _expedited(data: bytes) -> bytes:
    """The bytes in an initiate frame."""
    return data[4 : 8 - (data[0] >> 2 & 3)] if data[0] & 1 else data[4:8]
