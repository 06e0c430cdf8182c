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
"""

from collections.abc import Callable
from functools import partial

from servobench.drivers.canopen.cob_ids import SDO_ANSWER, SDO_REQUEST
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import SDO_SERVER
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.device.encoding import byte_length
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.device.sdo_abort import AbortCode, SdoAbort
from servobench.virtual_bus.device.sdo_transfer import (
    ABORT_COMMAND,
    BLOCK_SIZE_MAX,
    Commit,
    Transfer,
    block_download,
    block_upload,
    check_room,
    segmented_download,
    segmented_upload,
)
from servobench.virtual_bus.device.station import Station
from servobench.virtual_bus.frame import Frame

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
