"""A recording's decoded bus as lines, by columns: letter by letter what :func:`decode` gives frame by frame.

    frames     | sync pdo pdo pdo | sdo | pdo sync heartbeat pdo | ...
    stretches  '------------------'  1  '------------------------'

Within a stretch no SDO transfer ends and no node is new, so the layouts of PDOs, names and units stay: SYNCs
and PDOs of one identifier are decoded and worded together. All other frames are taken one by one.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.drivers.canopen.cob_ids import NODE_BITS, SDO_ANSWER, SDO_REQUEST, SYNC
from servobench.drivers.errors import printable
from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.wire.frame_port import STANDARD_ID_MAX
from servobench.hil.reviewing.trace.decoder import BusDecoder
from servobench.hil.reviewing.trace.frame_columns import CLASSICAL_BYTES_MAX, FrameColumns
from servobench.hil.reviewing.trace.node_objects import KnownNodes
from servobench.hil.reviewing.trace.pdo_book import (
    Clean,
    PdoLayout,
    Texts,
    between,
    decimals,
    hexadecimal,
    is_whole_numbers,
    joined,
    json_value,
    micro_seconds,
    pdo_text,
    shortest,
    texts_of,
    worded_values,
)
from servobench.hil.reviewing.trace.trace_entry import TraceEntry, TraceSelection
from servobench.hil.rows.side_rows import FRAME_DTYPE

_FEW: Final = 64
"""Frames that are sooner taken one by one."""
_MANY: Final = 1 << 16
"""Frames that are worded at once, in some 30 MB."""
_PDO_FIRST, _PDO_LAST = 0x181, 0x57F
_AT_WIDTH: Final = 14


class _Block(NamedTuple):
    """Frames of one identifier and length, in a stretch."""

    at: NDArray[np.int64]
    numbers: NDArray[np.int64]
    sent: NDArray[np.bool_]
    data: NDArray[np.uint8]
    """(n, length)."""

    @property
    def senders(self) -> Texts:
        return texts_of(["R", "T"]).take(pa.array(self.sent.astype(np.int8)))


class _Told(NamedTuple):
    """Lines, and behind which frames of the batch they stand."""

    places: NDArray[np.int64]
    lines: Texts


class TraceLines:
    """Lines of a recording, batch by batch."""

    def __init__(
        self,
        known: KnownNodes,
        selection: TraceSelection,
        zero_ns: int,
        line_of: Callable[[TraceEntry], str],
        as_json: bool,
    ) -> None:
        """``line_of``: the same line of one entry; ``zero_ns``: what times count from."""
        self._known, self._selection, self._zero_ns = known, selection, zero_ns
        self._line_of, self._as_json = line_of, as_json
        self._clean: Clean = (lambda text: json.dumps(text)[1:-1]) if as_json else printable
        self._decoders: dict[str, BusDecoder] = {}

    def of(self, columns: FrameColumns) -> Iterator[str]:
        """Yield the lines of all frames, many at once, each with its end."""
        for frames, numbers in _larger(columns.parts()):
            told: list[_Told] = []
            for segment in np.unique(frames["sent"] >> 1).tolist():
                mine = np.flatnonzero(frames["sent"] >> 1 == segment)
                told += self._of_bus(columns, frames, numbers, mine)
            yield _in_order(told)
        entries = [entry for decoder in self._decoders.values() for entry in decoder.close()]
        yield "".join(self._worded(entries))

    def _of_bus(
        self,
        columns: FrameColumns,
        frames: NDArray[np.void],
        numbers: NDArray[np.int64],
        mine: NDArray[np.int64],
    ) -> Iterator[_Told]:
        channel = columns.name_of(int(frames["sent"][mine[0]] >> 1))
        decoder = self._decoders.get(channel)
        if decoder is None:
            decoder = self._decoders[channel] = BusDecoder(self._known, channel)
        ids = frames["can_id"][mine].astype(np.int64)
        service = ids & ~NODE_BITS
        sdo = np.flatnonzero((ids <= STANDARD_ID_MAX) & ((service == SDO_REQUEST) | (service == SDO_ANSWER)))
        begin = 0
        for end in [*sdo.tolist(), mine.size]:
            while begin < end:
                stop = end
                if end - begin >= _FEW:
                    stop = begin + _first_new(ids[begin:end], decoder)
                    yield from self._stretch(columns, frames, numbers, mine[begin:stop], decoder)
                    begin, stop = stop, min(stop + 1, end)
                yield self._one_by_one(columns, frames, numbers, mine[begin:stop], decoder)
                begin = stop
            if end < mine.size:
                yield self._one_by_one(columns, frames, numbers, mine[end : end + 1], decoder)
                begin = end + 1

    def _one_by_one(
        self, columns: FrameColumns, frames: NDArray[np.void], numbers: NDArray[np.int64],
        places: NDArray[np.int64], decoder: BusDecoder,
    ) -> _Told:  # fmt: skip
        found: list[int] = []
        lines: list[str] = []
        for place, frame in zip(
            places.tolist(), columns.log_frames(frames[places], numbers[places]), strict=True
        ):
            for line in self._worded(decoder.take(frame)):
                found.append(place)
                lines.append(line)
        return _Told(np.array(found, np.int64), texts_of(lines))

    def _worded(self, entries: Iterable[TraceEntry]) -> Iterator[str]:
        for entry in self._selection.of(entries, self._zero_ns):
            yield f"{self._line_of(entry)}\n"

    def _stretch(
        self, columns: FrameColumns, frames: NDArray[np.void], numbers: NDArray[np.int64],
        places: NDArray[np.int64], decoder: BusDecoder,
    ) -> Iterator[_Told]:  # fmt: skip
        ids = frames["can_id"][places].astype(np.int64)
        lengths = np.minimum(frames["length"][places], CLASSICAL_BYTES_MAX)
        single = np.ones(places.size, np.bool_)
        keys = ids << 8 | lengths
        for key in np.unique(keys[_is_quick(ids)]).tolist():
            can_id, length = key >> 8, key & 0xFF
            layout = None if can_id == SYNC else decoder.layout(can_id)
            if can_id != SYNC and (layout is None or not is_whole_numbers(layout)):
                continue
            with_key = keys == key
            single &= ~with_key
            chosen = self._chosen(frames, places[with_key], layout)
            if chosen.size:
                block = _Block(
                    frames["at"][chosen].astype(np.int64), numbers[chosen],
                    (frames["sent"][chosen] & 1) != 0, frames["data"][chosen][:, :length],
                )  # fmt: skip
                name = columns.name_of(int(frames["sent"][chosen[0]] >> 1))
                yield _Told(chosen, self._block_lines(block, name, can_id, layout, decoder))
        if single.any():
            yield self._one_by_one(columns, frames, numbers, places[single], decoder)

    def _chosen(
        self, frames: NDArray[np.void], places: NDArray[np.int64], layout: PdoLayout | None
    ) -> NDArray[np.int64]:
        """Those of ``places`` that are wanted; ``layout``: None for SYNCs."""
        selection = self._selection
        kind, node = ("sync", None) if layout is None else ("pdo", layout.node)
        if (selection.kinds and kind not in selection.kinds) or selection.node not in (None, node):
            return places[:0]
        at_s = (frames["at"][places] - self._zero_ns) / NS_PER_S
        if selection.from_s is not None:
            places, at_s = places[at_s >= selection.from_s], at_s[at_s >= selection.from_s]
        return places if selection.to_s is None else places[at_s <= selection.to_s]

    def _block_lines(
        self, block: _Block, channel: str, can_id: int, layout: PdoLayout | None, decoder: BusDecoder
    ) -> Texts:
        kind, node = ("sync", None) if layout is None else ("pdo", layout.node)
        if layout is None:
            counters = decimals(block.data[:, 0]) if block.data.shape[1] == 1 else None
            text = "SYNC" if counters is None else joined("SYNC ", counters)
            values = []
        else:
            objects = decoder.objects(layout.node)
            values = list(worded_values(layout, block.data, objects, self._clean))
            text = joined(*pdo_text(layout, values, block.data.shape[1], self._clean))
        if not self._as_json:
            at = pa.compute.utf8_lpad(micro_seconds(block.at - self._zero_ns), _AT_WIDTH)
            name = self._clean(f" {channel:<8} ") if channel else " "
            of = f"node {node}" if node is not None else ""
            return joined(at, name, block.senders, f" {can_id:03X}  {kind:<9} {of:<8} ", text, "\n")
        head: dict[str, Any] = {"kind": kind, "node": node, "can_id": can_id, "channel": channel}
        tail = [', "data": "', hexadecimal(block.data), '"']
        if values:
            tail += [', "values": [', *between([json_value(value) for value in values], ", "), "]"]
        if layout is not None:
            tail.append(f', "pdo": {json.dumps(layout.name)}')
        elif block.data.shape[1] == 1:
            tail += [', "counter": ', decimals(block.data[:, 0])]
        return joined(
            '{"at_s": ', shortest((block.at - self._zero_ns) / 1e9), ', "stamp_ns": ', decimals(block.at),
            f', {json.dumps(head)[1:-1]}, "sent": "', block.senders, '", "frame": ',
            decimals(block.numbers), ', "text": "', text, '"', *tail, "}\n",
        )  # fmt: skip


def _larger(
    parts: Iterable[tuple[NDArray[np.void], NDArray[np.int64]]],
) -> Iterator[tuple[NDArray[np.void], NDArray[np.int64]]]:
    """Join parts of a few thousand frames: what is done for each block is done for more of them at once."""
    held: list[tuple[NDArray[np.void], NDArray[np.int64]]] = []
    count = 0
    for part in parts:
        held.append(part)
        count += part[0].size
        if count >= _MANY:
            yield _together(held)
            held, count = [], 0
    if count:
        yield _together(held)


def _together(
    parts: list[tuple[NDArray[np.void], NDArray[np.int64]]],
) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    count = sum(frames.size for frames, _ in parts)
    together, begin = np.empty(count, FRAME_DTYPE), 0
    for frames, _ in parts:
        for name in FRAME_DTYPE.names or ():  # rows of the index have more
            together[name][begin : begin + frames.size] = frames[name]
        begin += frames.size
    return together, np.concatenate([numbers for _, numbers in parts])


def _first_new(ids: NDArray[np.int64], decoder: BusDecoder) -> int:
    """Place of the first frame by which a node becomes known; behind the last if there is none."""
    found, first = np.unique(ids, return_index=True)
    new = [
        place
        for can_id, place in zip(found.tolist(), first.tolist(), strict=True)
        if decoder.makes_known(can_id)
    ]
    return min(new, default=ids.size)


def _is_quick(ids: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Data frames of SYNC and of the usual PDOs."""
    pdo = (ids >= _PDO_FIRST) & (ids <= _PDO_LAST) & (ids & NODE_BITS != 0)
    quick: NDArray[np.bool_] = pdo | (ids == SYNC)
    return quick


def _in_order(told: list[_Told]) -> str:
    """The lines in order of their frames."""
    told = [each for each in told if each.places.size]
    if not told:
        return ""
    order = np.argsort(np.concatenate([each.places for each in told]), kind="stable")
    lines = pa.concat_arrays([each.lines for each in told]).take(pa.array(order))
    _, begins, letters = lines.buffers()
    first, last = np.frombuffer(begins, np.int32, len(lines) + 1, lines.offset * 4)[[0, -1]].tolist()
    return bytes(letters[first:last]).decode()
