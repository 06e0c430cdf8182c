"""Frames in, lines in words out: what a CANopen bus said, by CiA 301, CiA 305 and CiA 402."""

from collections.abc import Iterable, Iterator
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
from servobench.drivers.canopen.objects301 import PDO_PARAMETERS, Cia301
from servobench.drivers.canopen.sdo import abort_text, object_name
from servobench.drivers.wire.error_frames import error_frame_text
from servobench.hil.reviewing.trace.known_nodes import KnownNodes
from servobench.hil.reviewing.trace.log_frame import LogFrame
from servobench.hil.reviewing.trace.log_window import EVER_NS
from servobench.hil.reviewing.trace.node_objects import NodeObjects
from servobench.hil.reviewing.trace.object_value import ObjectValue
from servobench.hil.reviewing.trace.pdo_book import PdoBook
from servobench.hil.reviewing.trace.sdo_transfer import SdoChannel, SdoTransfer
from servobench.hil.reviewing.trace.service_words import (
    emergency_text,
    error_control_text,
    lss_text,
    nmt_text,
    time_text,
)
from servobench.hil.reviewing.trace.trace_entry import TraceEntry

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
            objects = self._objects(node)
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

    def has_open_transfer(self, begun_by_ns: int) -> bool:
        """Return True if an SDO transfer that began by then has not ended."""
        pending = [channel.pending for channel in self._sdo.values()]
        return any(one is not None and (one.first.at_ns or 0) <= begun_by_ns for one in pending)

    def _objects(self, node: int) -> NodeObjects:
        objects = self._nodes.get(node)
        if objects is None:
            objects = self._nodes[node] = self._known.objects(self._channel, node)
            self._pdos.stale = True
        return objects

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
        self._objects(node)
        if frame.remote:
            self._guarded.add(node)
            return _entry(frame, "guarding", node, "asked for its state")
        kind, text = error_control_text(frame.data, node in self._guarded)
        self._guarded.discard(node)
        return _entry(frame, kind, node, text)

    def _process_data(self, frame: LogFrame) -> TraceEntry:
        layout = self._pdos.layout(frame.can_id, self._nodes)
        if layout is None:
            return _entry(frame, "other", None, "no identifier of CANopen")
        if layout.node not in self._nodes:
            self._objects(layout.node)
            layout = self._pdos.layout(frame.can_id, self._nodes) or layout
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
        objects = self._objects(node)
        index, sub, data = transfer.index, transfer.sub, bytes(transfer.data)
        if transfer.whole and (data or not transfer.download):
            objects.take(index, sub, data)
            if index == Cia301.IDENTITY and self._known.identified(objects, node):
                self._pdos.stale = True
            self._pdos.stale |= index in PDO_PARAMETERS
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
