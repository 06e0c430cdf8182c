"""SDO transfers put together from their frames: expedited, segmented and block (CiA 301 7.2.4).

One channel carries one transfer at a time. A transfer is told where it ends: confirmed, aborted, given up for
another one, or cut off by the end of the log.
"""

from binascii import crc_hqx
from dataclasses import dataclass, field
from typing import Final

from hil.reviewing.trace.log_frame import LogFrame

KEPT_MAX: Final = 1 << 20
"""Bytes of a transfer that are kept, so that no log fills the memory; a firmware file may be longer."""
_SEGMENT: Final = 7
_ABORT: Final = 0x80
_LAST: Final = 0x80
"""Of a block's segment; 1 to 127 in the other bits are its number."""


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
    """What was odd with it."""

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
        """Of the block's last segment, in its sub-block; 0 while it has not come."""
        self._seen_last = False
        self._crc = [False, False]
        """Whether client and server reckon one."""
        self._complete = True
        """No segment of the transfer is missing in the log."""

    @property
    def pending(self) -> SdoTransfer | None:
        """The transfer that has not ended."""
        return self._open

    def request(self, frame: LogFrame) -> list[SdoTransfer]:
        """A frame of the client; the transfers that end with it."""
        data = frame.data
        if not data:
            self._count(frame)
            return []
        if self._block is not None and self._open is not None and self._open.download and data[0] != _ABORT:
            return self._block_segment(frame)
        if len(data) < 8:
            self._count(frame)
            return []
        command = data[0] >> 5
        if command in (1, 2) or (command == 5 and data[0] & 3 == 0) or (command == 6 and not data[0] & 1):
            return self._begin(frame, command)
        transfer = self._count(frame)
        if transfer is None:
            return []
        if command == 4:
            return self._abort(frame, "client")
        if command == 0 and transfer.download:
            self._segment(data)
        elif command == 5 and data[0] & 3 == 3:
            self._block, self._last_number = {}, 0
        elif command == 5 and data[0] & 3 == 2:
            self._acknowledged(data[1])
        elif command == 5 and data[0] & 3 == 1 and not transfer.download:
            return self._end()
        elif command == 6 and data[0] & 1:
            self._end_of_data(transfer, data)
        return []

    def answer(self, frame: LogFrame) -> list[SdoTransfer]:
        """A frame of the server; the transfers that end with it."""
        data, transfer = frame.data, self._open
        if not data:
            self._count(frame)
            return []
        upload = transfer is not None and not transfer.download
        if self._block is not None and upload and data[0] != _ABORT:
            return self._block_segment(frame)
        if len(data) < 8:
            self._count(frame)
            return []
        if transfer is None or (data[0] >> 5 in (2, 3) and _object(data) != (transfer.index, transfer.sub)):
            return self._unasked(frame)
        self._count(frame)
        if data[0] >> 5 == 4:
            return self._abort(frame, "server")
        return self._of_download(transfer, data) if transfer.download else self._of_upload(transfer, data)

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
            if data[0] & 2:
                transfer.add(_expedited(data))
            else:
                transfer.kind = "segmented"
                transfer.announced = _size(data) if data[0] & 1 else None
        elif command == 5:
            transfer.kind, self._crc = "block", [bool(data[0] & 4), False]
        elif command == 6:
            transfer.kind, self._crc = "block", [bool(data[0] & 4), False]
            transfer.announced = _size(data) if data[0] & 2 else None
        return ended

    def _count(self, frame: LogFrame) -> SdoTransfer | None:
        if self._open is not None:
            self._open.frames += 1
            self._open.last = frame
        return self._open

    def _end(self) -> list[SdoTransfer]:
        transfer = self._open
        if transfer is None:
            return []
        transfer.finished = True
        if not self._complete:
            transfer.notes.append("segments are missing")
        elif transfer.announced is not None and transfer.announced != transfer.length:
            transfer.notes.append(f"{transfer.announced} bytes were announced, {transfer.length} came")
        return self.close()

    def _abort(self, frame: LogFrame, who: str) -> list[SdoTransfer]:
        transfer = self._open
        if transfer is None:
            return []
        transfer.abort_code, transfer.aborted_by = _size(frame.data), who
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

    def _of_download(self, transfer: SdoTransfer, data: bytes) -> list[SdoTransfer]:
        """An answer: everything confirmed, a segment, or a step of a block."""
        command = data[0] >> 5
        if command == 3:
            return self._end() if transfer.kind == "expedited" else []
        if command == 1:
            return self._end() if self._seen_last else []
        return self._block_answer(data) if command == 5 else []

    def _of_upload(self, transfer: SdoTransfer, data: bytes) -> list[SdoTransfer]:
        """An answer: all of the value, its announcement, or a piece of it."""
        command = data[0] >> 5
        if command == 2:
            return self._uploaded(transfer, data)
        if command == 0:
            return self._segment(data)
        if command == 6 and data[0] & 1:
            self._end_of_data(transfer, data)
        elif command == 6:
            self._crc[1] = bool(data[0] & 4)
            transfer.announced = _size(data) if data[0] & 2 else None
        return []

    # ---- segments -------------------------------------------------------------------------------------

    def _uploaded(self, transfer: SdoTransfer, data: bytes) -> list[SdoTransfer]:
        if data[0] & 2:
            transfer.kind = "expedited"
            transfer.add(_expedited(data))
            return self._end()
        transfer.kind = "segmented"
        transfer.announced = _size(data) if data[0] & 1 else None
        return []

    def _segment(self, data: bytes) -> list[SdoTransfer]:
        """Of a segmented transfer, from whichever side.

        The toggle bit alternates from 0 on: the same frame is sent again, another one with the same bit
        follows one that is missing.
        """
        transfer, before = self._open, self._segment_before
        if transfer is None or self._seen_last or data == before:
            return []
        self._complete &= _toggle(data) == (0 if before is None else 1 - _toggle(before))
        self._segment_before = data
        transfer.add(data[1 : 1 + _SEGMENT - (data[0] >> 1 & 7)])
        self._seen_last = bool(data[0] & 1)
        return self._end() if self._seen_last and not transfer.download else []

    # ---- blocks ---------------------------------------------------------------------------------------

    def _block_segment(self, frame: LogFrame) -> list[SdoTransfer]:
        """Of the sub-block under way; it counts once it is acknowledged."""
        self._count(frame)
        assert self._block is not None
        number = frame.data[0] & 0x7F
        self._block[number] = frame.data[1:8]
        if frame.data[0] & _LAST:
            self._last_number = number
        return []

    def _block_answer(self, data: bytes) -> list[SdoTransfer]:
        """Of the server of a download."""
        step = data[0] & 3
        if step == 0:
            self._crc[1] = bool(data[0] & 4)
            self._block, self._last_number = {}, 0
        elif step == 2:
            self._acknowledged(data[1])
        elif step == 1:
            return self._end()
        return []

    def _acknowledged(self, count: int) -> None:
        """So many segments of the sub-block have come; the others will be sent again."""
        block, transfer = self._block, self._open
        if block is None or transfer is None:
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


def _toggle(segment: bytes) -> int:
    return segment[0] >> 4 & 1


def _expedited(data: bytes) -> bytes:
    """The bytes in an initiate frame."""
    return data[4 : 8 - (data[0] >> 2 & 3)] if data[0] & 1 else data[4:8]
