"""Frames in, lines in words out: what a CANopen bus said, by CiA 301, CiA 305 and CiA 402.

NMT, TIME, EMCY and error control: CiA 301 7.2.6 to 7.2.8.
"""

from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Final

from servobench.drivers.canopen.cob_ids import (
    EMERGENCY,
    ERROR_CONTROL,
    LSS_ANSWER,
    LSS_REQUEST,
    NMT,
    NODE_BITS,
    SDO_ANSWER,
    SDO_REQUEST,
    SYNC,
    TIME,
)
from servobench.drivers.canopen.error_codes import fault_text
from servobench.drivers.canopen.lss import SCAN_RESET
from servobench.drivers.canopen.nmt import parse_emergency
from servobench.drivers.canopen.nmt_states import UNCONFIGURED, NmtCommand, NmtState
from servobench.drivers.canopen.objects301 import PDO_PARAMETERS, Cia301, object_name
from servobench.drivers.canopen.sdo import abort_text
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.error_frames import error_frame_text
from servobench.hil.reviewing.trace.frame_columns import EVER_NS, LogFrame
from servobench.hil.reviewing.trace.node_objects import KnownNodes, NodeObjects
from servobench.hil.reviewing.trace.object_value import ObjectValue
from servobench.hil.reviewing.trace.pdo_book import PdoBook, PdoLayout
from servobench.hil.reviewing.trace.sdo_transfer import SdoChannel, SdoTransfer
from servobench.hil.reviewing.trace.trace_entry import TraceEntry

_EPOCH: Final = datetime(1984, 1, 1, tzinfo=UTC)
"""TIME_OF_DAY counts its days from here (CiA 301 7.1.6.6)."""
_TIME_BYTES: Final = 6
_PARTS: Final = ("vendor-ID", "product code", "revision number", "serial number")
_IDENTIFY: Final = (
    "vendor-ID", "product code", "lowest revision", "highest revision", "lowest serial", "highest serial",
)  # fmt: skip
_BIT_RATES_KBIT_S: Final = (1000, 800, 500, 250, 125, None, 50, 20, 10)
"""Table 0 of CiA 305 by index; 9: found by the device itself."""
_DETECTED: Final = 9
_OTHER_ERROR: Final = 0xFF
_CONFIRMED: Final = {
    0x11: {1: "node-ID out of range"},
    0x13: {1: "bit timing not supported"},
    0x17: {1: "storing not supported", 2: "storage medium does not answer"},
}


def nmt_text(data: bytes) -> tuple[int | None, str]:
    """The node that is meant, None for all, and the command."""
    if len(data) != 2:
        return None, f"NMT command of {len(data)} bytes; it has 2"
    known = data[0] in NmtCommand.__members__.values()
    command = NmtCommand(data[0]).name.lower().replace("_", " ") if known else f"command {data[0]:02X}h"
    return data[1] or None, f"{command}, {f'node {data[1]}' if data[1] else 'all nodes'}"


def time_text(data: bytes) -> str:
    """TIME_OF_DAY as a date."""
    if len(data) != _TIME_BYTES:
        return f"TIME of {len(data)} bytes; it has 6"
    ms, days = int.from_bytes(data[:4], "little") & 0x0FFF_FFFF, int.from_bytes(data[4:], "little")
    return (_EPOCH + timedelta(days=days, milliseconds=ms)).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]


def emergency_text(node: int, data: bytes, make: tuple[int, str]) -> str:
    """An EMCY with the words of the drive's maker."""
    emergency = parse_emergency(node, data, Instant(0))
    if emergency is None:
        code = int.from_bytes(data[:2], "little")
        return f"EMCY of {len(data)} bytes; it has 8" + (
            f": {code:04X}h ({fault_text(code, *make)})" if len(data) >= 2 else ""
        )
    return emergency.told(*make)


def error_control_text(data: bytes, guarded: bool) -> tuple[str, str]:
    """Kind of the entry, heartbeat or guarding, and the state that is told."""
    if len(data) != 1:
        return "heartbeat", f"error control of {len(data)} bytes; it has 1"
    number, toggle = data[0] & 0x7F, data[0] >> 7
    known = number in NmtState.__members__.values()
    state = NmtState(number).name.lower().replace("_", "-") if known else f"state {number:02X}h"
    if guarded or toggle:
        return "guarding", f"{state}, toggle {toggle}"
    return "heartbeat", "boot-up" if number == NmtState.INITIALISING else state


def lss_text(data: bytes, answer: bool) -> str:
    """A frame of the master, or of a slave if ``answer``."""
    if len(data) != 8:
        return f"LSS of {len(data)} bytes; it has 8"
    command, number = data[0], int.from_bytes(data[1:5], "little")
    if command == 0x04:
        states = {0: "waiting", 1: "configuration"}
        return f"switch all to state {states.get(data[1], data[1])}"
    if 0x40 <= command <= 0x43:
        return f"select {_PARTS[command - 0x40]} {number:08X}h"
    if 0x46 <= command <= 0x4B:
        return f"identify {_IDENTIFY[command - 0x46]} {number:08X}h"
    if 0x5A <= command <= 0x5D:
        return f"{_PARTS[command - 0x5A]} is {number:08X}h" if answer else f"ask {_PARTS[command - 0x5A]}"
    if command == 0x51:
        return _fast_scan(data, number)
    if command in _CONFIRMED and answer:
        return _confirmation(data)
    return _plain(data, answer)


def _fast_scan(data: bytes, number: int) -> str:
    bit, part, following = data[5], data[6], data[7]
    if bit == SCAN_RESET:
        return "fast scan: is anybody without node-ID?"
    name = _PARTS[part] if part < len(_PARTS) else f"part {part}"
    then = f", then {_PARTS[following]}" if following < len(_PARTS) and following != part else ""
    return f"fast scan: {name} {number:08X}h down to bit {bit}{then}"


def _confirmation(data: bytes) -> str:
    what = {0x11: "node-ID", 0x13: "bit timing", 0x17: "store"}[data[0]]
    if not data[1]:
        return f"{what}: done"
    reason = _CONFIRMED[data[0]].get(data[1], f"error {data[1]}")
    return f"{what}: refused, " + (f"error {data[2]} of the maker" if data[1] == _OTHER_ERROR else reason)


def _plain(data: bytes, answer: bool) -> str:
    command, value = data[0], data[1]
    if command == 0x11:
        return "configure no node-ID" if value == UNCONFIGURED else f"configure node-ID {value}"
    if command == 0x13:
        return f"configure bit timing: table {value}, {_bit_rate(value, data[2])}"
    if command == 0x15:
        return f"activate bit timing after {value | data[2] << 8} ms"
    if command == 0x5E:
        return f"node-ID is {value}" if answer else "ask node-ID"
    texts = {
        0x17: "store configuration",
        0x44: "selected",
        0x4C: "is anybody without node-ID?",
        0x4F: "identified",
        0x50: "here is one without node-ID",
    }
    return texts.get(command, f"command {command:02X}h")


def _bit_rate(table: int, index: int) -> str:
    if table == 0 and index == _DETECTED:
        return "found by the device"
    rate = _BIT_RATES_KBIT_S[index] if table == 0 and index < len(_BIT_RATES_KBIT_S) else None
    return f"index {index}" if rate is None else f"{rate} kbit/s"


_NO_OBJECT: Final = (0x0602_0000, 0x0609_0011)
"""Abort codes of an object or a sub-index that is not there (CiA 301 table 22)."""
_SDO_BYTES: Final = 8


def decode(
    frames: Iterable[LogFrame], known: KnownNodes | None = None, until_ns: int = EVER_NS
) -> Iterator[TraceEntry]:
    """The frames of a log or a live bus in words, in order of time; an SDO transfer comes where it ends.

    ``known``: data sheets and scales. ``until_ns``: of a log in order of time, nothing is asked for that ends
    later. A page of a recording is made of the same entries.
    """
    known = known or KnownNodes()
    channels: dict[str, BusDecoder] = {}
    for frame in frames:
        behind = (frame.at_ns or 0) > until_ns
        if behind and not any(decoder.has_open_transfer(until_ns) for decoder in channels.values()):
            return
        decoder = channels.get(frame.channel)
        if decoder is None:
            decoder = channels[frame.channel] = BusDecoder(known, frame.channel)
        yield from decoder.take(frame)
    for decoder in channels.values():
        yield from decoder.close()


class BusDecoder:
    """Decoder of one bus: it remembers what the nodes have reported."""

    def __init__(self, known: KnownNodes, channel: str) -> None:
        self._known = known
        self._channel = channel
        self._nodes: dict[int, NodeObjects] = {}
        self._sdo: dict[int, SdoChannel] = {}
        self._pdos = PdoBook()
        self._guarded: set[int] = set()
        """Nodes that were asked by node guarding, and have not answered."""

    def take(self, frame: LogFrame) -> list[TraceEntry]:
        """Return the entries that end with this frame: one, none inside of an SDO transfer, two where one was
        cut off."""
        if frame.error:
            return [_entry(frame, "error", None, error_frame_text(frame.can_id, frame.data))]
        if frame.extended or frame.fd:
            what = "CAN FD frame" if frame.fd else "29-bit identifier"
            return [_entry(frame, "other", None, f"{what}: no CANopen")]
        can_id, node = frame.can_id, frame.can_id & NODE_BITS
        service = can_id & ~NODE_BITS
        if can_id in (LSS_REQUEST, LSS_ANSWER):
            answer = can_id == LSS_ANSWER
            text = ("answer: " if answer else "") + lss_text(frame.data, answer)
            return [_entry(frame, "lss", None, text)]
        if not node:
            return [self._broadcast(frame)]
        if service in (SDO_REQUEST, SDO_ANSWER) and not frame.remote:
            return self._take_sdo(frame, node, answer=service == SDO_ANSWER)
        if service == ERROR_CONTROL:
            return [self._error_control(frame, node)]
        if service == EMERGENCY and not frame.remote:
            objects = self.objects(node)
            code = int.from_bytes(frame.data[:2], "little") if len(frame.data) >= 2 else None
            text = emergency_text(node, frame.data, objects.make)
            return [_entry(frame, "emcy", node, text)._replace(details=(("error_code", code),))]
        return [self._process_data(frame)]

    def close(self) -> list[TraceEntry]:
        """The log ends."""
        return [
            self._transferred(node, transfer)
            for node, channel in sorted(self._sdo.items())
            for transfer in channel.close()
        ]

    @property
    def mappings(self) -> int:
        """How often a PDO may have got another layout so far."""
        return self._pdos.changes

    def layout(self, can_id: int) -> PdoLayout | None:
        """Return the layout of the PDO that an identifier stands for, whose node is known from now on; None:
        it is that of no PDO."""
        layout = self._pdos.layout(can_id, self._nodes)
        if layout is not None and layout.node not in self._nodes:
            self.objects(layout.node)
            layout = self._pdos.layout(can_id, self._nodes) or layout
        return layout

    def makes_known(self, can_id: int) -> bool:
        """Return True if a frame with this identifier may make a node known."""
        node, service = can_id & NODE_BITS, can_id & ~NODE_BITS
        if node and service in (ERROR_CONTROL, EMERGENCY):
            return node not in self._nodes
        layout = self._pdos.layout(can_id, self._nodes)
        return layout is not None and layout.node not in self._nodes

    def objects(self, node: int) -> NodeObjects:
        """Return what is known of a node's objects."""
        objects = self._nodes.get(node)
        if objects is None:
            objects = self._nodes[node] = self._known.objects(self._channel, node)
            self._pdos.mark_stale()
        return objects

    def has_open_transfer(self, begun_by_ns: int) -> bool:
        """Return True if an SDO transfer that began by then has not ended."""
        pending = [channel.pending for channel in self._sdo.values()]
        return any(one is not None and (one.first.at_ns or 0) <= begun_by_ns for one in pending)

    def _broadcast(self, frame: LogFrame) -> TraceEntry:
        if frame.remote:
            return self._process_data(frame)
        if frame.can_id == NMT:
            node, text = nmt_text(frame.data)
            return _entry(frame, "nmt", node, text)
        if frame.can_id == SYNC:
            counter = frame.data[0] if len(frame.data) == 1 else None
            text = "SYNC" if counter is None else f"SYNC {counter}"
            entry = _entry(frame, "sync", None, text)
            return entry if counter is None else entry._replace(details=(("counter", counter),))
        if frame.can_id == TIME:
            return _entry(frame, "time", None, time_text(frame.data))
        return self._process_data(frame)

    def _error_control(self, frame: LogFrame, node: int) -> TraceEntry:
        self.objects(node)
        if frame.remote:
            self._guarded.add(node)
            return _entry(frame, "guarding", node, "asked for its state")
        kind, text = error_control_text(frame.data, node in self._guarded)
        self._guarded.discard(node)
        return _entry(frame, kind, node, text)

    def _process_data(self, frame: LogFrame) -> TraceEntry:
        layout = self.layout(frame.can_id)
        if layout is None:
            return _entry(frame, "other", None, "no identifier of CANopen")
        node, name = layout.node, layout.name
        if frame.remote:
            return _entry(frame, "pdo", node, f"{name} asked for by a remote frame")
        details = (("pdo", name),)
        if layout.objects is None:
            text = f"{name} {frame.data.hex(' ')} (its mapping is not known)"
            return _entry(frame, "pdo", node, text)._replace(details=details)
        values = layout.values(frame.data, self._nodes[node])
        text = f"{name} " + ", ".join(map(str, values))
        if 8 * len(frame.data) < layout.bits:
            text += f" (it has {8 * len(frame.data)} bits, {layout.bits} are mapped)"
        return _entry(frame, "pdo", node, text)._replace(values=values, details=details)

    # ---- SDO ------------------------------------------------------------------------------------------

    def _take_sdo(self, frame: LogFrame, node: int, answer: bool) -> list[TraceEntry]:
        channel = self._sdo.get(node)
        if channel is None:
            channel = self._sdo[node] = SdoChannel()
        ended = channel.take(frame, answer)
        if not ended and channel.pending is None:
            what = "answer" if answer else "request"
            text = f"{what} {frame.data.hex(' ')} of a transfer whose beginning is not in the log"
            if len(frame.data) < _SDO_BYTES:
                text = f"{what} of {len(frame.data)} bytes; it has {_SDO_BYTES}"
            return [_entry(frame, "sdo", node, text)]
        return [self._transferred(node, transfer) for transfer in ended]

    def _transferred(self, node: int, transfer: SdoTransfer) -> TraceEntry:
        objects = self.objects(node)
        index, sub, data = transfer.index, transfer.sub, bytes(transfer.data)
        if transfer.whole and (data or not transfer.download):
            objects.take(index, sub, data)
            found = index == Cia301.IDENTITY and self._known.identified(objects, node)
            if found or index in PDO_PARAMETERS:
                self._pdos.mark_stale()
        elif not transfer.download and transfer.abort_code in _NO_OBJECT:
            objects.lacks(index, sub)
        value = objects.value(index, sub, data)
        last = transfer.last
        return TraceEntry(
            at_ns=last.at_ns,
            began_ns=transfer.first.at_ns,
            first=transfer.first.number,
            last=last.number,
            frames=transfer.frames,
            channel=last.channel,
            can_id=last.can_id,
            sent=last.sent,
            kind="sdo",
            node=node,
            text=_sdo_text(transfer, value),
            values=(value,) if data else (),
            data=data,
            details=_sdo_details(transfer),
        )


def _sdo_text(transfer: SdoTransfer, value: ObjectValue) -> str:
    verb = "write" if transfer.download else "read"
    name = object_name(value.index, value.sub) + (f" {value.name}" if value.name else "")
    shown = f" = {value.shown}" if transfer.data else ""
    if transfer.abort_code is not None:
        text = f"{verb} {name}{shown}: {transfer.aborted_by} aborts, {abort_text(transfer.abort_code)}"
    elif not transfer.finished and not (transfer.notes and transfer.download):
        text = f"{verb} {name}{shown}: not answered to its end"
    else:
        text = f"{verb} {name}{shown}"
    told = [] if transfer.kind == "expedited" else [f"{transfer.kind}, {transfer.length} bytes"]
    if transfer.asked > 1:
        told.append(f"asked {transfer.asked} times")
    if transfer.length > len(transfer.data):
        told.append(f"the first {len(transfer.data)} are kept")
    told += transfer.notes
    return f"{text} [{'; '.join(told)}]" if told else text


def _sdo_details(transfer: SdoTransfer) -> tuple[tuple[str, object], ...]:
    return (
        ("index", transfer.index),
        ("sub", transfer.sub),
        ("direction", "download" if transfer.download else "upload"),
        ("transfer", transfer.kind),
        ("length", transfer.length),
        ("finished", transfer.finished),
        ("abort_code", transfer.abort_code),
        ("notes", list(transfer.notes)),
    )


def _entry(frame: LogFrame, kind: str, node: int | None, text: str) -> TraceEntry:
    return TraceEntry(
        frame.at_ns, frame.at_ns, frame.number, frame.number, 1, frame.channel, frame.can_id, frame.sent,
        kind, node, text, data=frame.data,
    )  # fmt: skip
