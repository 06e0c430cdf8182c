"""What was written to one node and read of it, by the frames on the bus alone (CiA 301 7.2.2, 7.2.4, 7.3).

A second reading of the standard: nothing here comes from ``servobench.drivers.canopen`` or
``servobench.virtual_bus.device``, whose errors would hide a write from the witness.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

_COB_IDS: Final = 0x7FF
_RESETS: Final = (0x81, 0x82)
"""NMT commands after which a node has its power-on values (CiA 301 7.2.8.2.1)."""


class Frame(NamedTuple):
    """One data frame with an 11-bit identifier."""

    at_s: float
    cob_id: int
    data: bytes


@dataclass(frozen=True)
class Access:
    """One access to an object of the node."""

    way: str
    """``sdo`` or ``rpdo``."""
    writes: bool
    index: int
    sub: int
    data: bytes
    """What was written, or read; of an access that was refused, what was to be written."""
    abort: int | None = None
    """Abort code, of either side."""

    def __str__(self) -> str:
        did = "written" if self.writes else "read"
        refused = "" if self.abort is None else f", refused with {self.abort:08X}h"
        return f"{self.index:04X}h:{self.sub:02X} {did} by {self.way} {self.data.hex() or '-'}{refused}"


class _Transfer:
    """A transfer that was begun."""

    def __init__(self, writes: bool, multiplexer: bytes) -> None:
        self.writes = writes
        self.index = int.from_bytes(multiplexer[:2], "little")
        self.sub = multiplexer[2]
        self.data = b""
        self.block: dict[int, bytes] = {}
        """Segments of the sub-block under way, by sequence number."""
        self.in_block = self.ended = False

    def access(self, abort: int | None = None) -> Access:
        return Access("sdo", self.writes, self.index, self.sub, self.data, abort)


class SdoListener:
    """One server's default channel, both directions; an access comes out when it is over."""

    def __init__(self) -> None:
        self._transfer: _Transfer | None = None

    def request(self, data: bytes) -> Iterator[Access]:
        """A frame of the client, 600h + node."""
        transfer = self._transfer
        if transfer is not None and transfer.writes and transfer.in_block:
            yield from self._block_segment(transfer, data)
            return
        service = data[0] >> 5
        if service in (1, 2) or (
            service in (5, 6) and not data[0] & 0x01 and (service == 6 or data[0] & 3 == 0)
        ):
            if transfer is not None:  # no answer came: the write may have been done all the same
                yield transfer.access()
            self._transfer = transfer = _Transfer(service in (1, 6), data[1:4])
            if service == 1 and data[0] & 0x02:  # expedited; n says how many bytes are none
                transfer.data = data[4 : 8 - (data[0] >> 2 & 3)] if data[0] & 0x01 else data[4:8]
                transfer.ended = True
        elif service == 0 and transfer is not None and transfer.writes:
            transfer.data += data[1 : 8 - (data[0] >> 1 & 7)]
            transfer.ended = bool(data[0] & 0x01)
        elif (
            service == 6 and transfer is not None
        ):  # end of a block download; n bytes of the last segment are none
            unused = data[0] >> 2 & 7
            transfer.data = transfer.data[:-unused] if unused else transfer.data
            transfer.ended = True
        elif service == 5 and transfer is not None and data[0] & 3 == 3:
            transfer.in_block = True
        elif service == 4:
            yield from self._over(int.from_bytes(data[4:8], "little"))

    def _block_segment(self, transfer: _Transfer, data: bytes) -> Iterator[Access]:
        if data[0] == 0x80:  # sequence number 0 is none: an abort
            yield from self._over(int.from_bytes(data[4:8], "little"))
            return
        transfer.block[data[0] & 0x7F] = data[1:8]
        transfer.ended = bool(data[0] & 0x80)

    def answer(self, data: bytes) -> Iterator[Access]:
        """A frame of the server, 580h + node."""
        transfer = self._transfer
        if transfer is None:
            return
        if not transfer.writes and transfer.in_block and data[0] != 0x80 and not transfer.ended:
            transfer.data += data[1:8]
            transfer.ended = bool(data[0] & 0x80)
            transfer.in_block = not transfer.ended
            return
        service = data[0] >> 5
        if service == 4:
            yield from self._over(int.from_bytes(data[4:8], "little"))
        elif transfer.writes:
            yield from self._answer_to_download(transfer, service, data)
        elif service == 2:  # initiate upload
            if data[0] & 0x02:
                transfer.data = data[4 : 8 - (data[0] >> 2 & 3)] if data[0] & 0x01 else data[4:8]
                yield from self._over()
        elif service == 0:
            transfer.data += data[1 : 8 - (data[0] >> 1 & 7)]
            if data[0] & 0x01:
                yield from self._over()
        elif service == 6 and data[0] & 3 == 1:  # end of a block upload
            unused = data[0] >> 2 & 7
            transfer.data = transfer.data[:-unused] if unused else transfer.data
            yield from self._over()

    def _answer_to_download(self, transfer: _Transfer, service: int, data: bytes) -> Iterator[Access]:
        if service in (1, 3) and transfer.ended:
            yield from self._over()
        elif service == 5 and data[0] & 3 == 0:  # initiate block download
            transfer.in_block = True
        elif service == 5 and data[0] & 3 == 2:  # a sub-block; what lies behind ackseq is sent again
            taken = [transfer.block[number] for number in sorted(transfer.block) if number <= data[1]]
            transfer.in_block = not (transfer.ended and len(taken) == len(transfer.block))
            transfer.data += b"".join(taken)
            transfer.block.clear()
        elif service == 5 and data[0] & 3 == 1:
            yield from self._over()

    def _over(self, abort: int | None = None) -> Iterator[Access]:
        transfer, self._transfer = self._transfer, None
        if transfer is not None:
            yield transfer.access(abort)

    def left_open(self) -> Iterator[Access]:
        """The transfer that nobody ended."""
        yield from self._over()


class NodeListener:
    """Everything that reaches one node. ``parameters``: its PDO parameters, 1400h to 1BFFh, as they are after
    power-on, by index and sub-index."""

    def __init__(self, node: int, parameters: dict[tuple[int, int], bytes]) -> None:
        self._node = node
        self._sdo = SdoListener()
        self._power_on = {key: int.from_bytes(value, "little") for key, value in parameters.items()}
        self._parameters = dict(self._power_on)
        self.unexplained: set[int] = set()
        """Identifiers that belong to none of the node's services."""

    def accesses(self, frames: Iterable[Frame]) -> Iterator[Access]:
        """All of them, in the order of the frames."""
        for frame in frames:
            for access in self._of_frame(frame):
                if access.way == "sdo" and access.writes and access.abort is None:
                    self._note(access)
                yield access
        yield from self._sdo.left_open()

    def _of_frame(self, frame: Frame) -> Iterator[Access]:
        if frame.cob_id == 0x600 + self._node and len(frame.data) == 8:
            yield from self._sdo.request(frame.data)
        elif frame.cob_id == 0x580 + self._node and len(frame.data) == 8:
            yield from self._sdo.answer(frame.data)
        elif frame.cob_id == 0:
            if frame.data[0] in _RESETS and frame.data[1] in (0, self._node):
                self._parameters = dict(self._power_on)
        else:
            numbers = [number for number in range(8) if self._identifier(0x1400, number) == frame.cob_id]
            for number in numbers:
                yield from self._of_rpdo(number, frame.data)
            if not numbers and not self._is_known(frame.cob_id):
                self.unexplained.add(frame.cob_id)

    def _is_known(self, cob_id: int) -> bool:
        """NMT, SYNC, EMCY and error control of anybody, and the node's TPDOs (CiA 301 7.3.5)."""
        if cob_id in (0x080, 0x080 + self._node) or 0x700 < cob_id < 0x780:
            return True
        return any(self._identifier(0x1800, number) == cob_id for number in range(8))

    def _identifier(self, base: int, number: int) -> int | None:
        cob_id = self._parameters.get((base + number, 1), 1 << 31)
        return None if cob_id >> 31 & 1 else cob_id & _COB_IDS

    def _of_rpdo(self, number: int, data: bytes) -> Iterator[Access]:
        bits, at = int.from_bytes(data, "little"), 0
        for sub in range(1, self._parameters.get((0x1600 + number, 0), 0) + 1):
            word = self._parameters.get((0x1600 + number, sub), 0)
            length = word & 0xFF
            value = bits >> at & (1 << length) - 1
            at += length
            if word >> 16 >= 0x20:  # below: a placeholder, by type
                yield Access(
                    "rpdo", True, word >> 16, word >> 8 & 0xFF, value.to_bytes(-(-length // 8), "little")
                )

    def _note(self, access: Access) -> None:
        if 0x1400 <= access.index < 0x1C00:
            self._parameters[access.index, access.sub] = int.from_bytes(access.data, "little")
