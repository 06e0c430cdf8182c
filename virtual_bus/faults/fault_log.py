"""The log of injected faults: one entry for each frame that a fault touched, and for each event that struck a
node.

An entry says which frame: the ``n``-th (from 0, since the plan's time zero) of its identifier in its
direction, so a run that is repeated with these entries meets the same faults, whatever its seed. As a
line of JSON, by kind (each says so itself, :class:`.log_kind.LogKind`):

    loss, burst, periodic_loss, blackout    at_ns, direction, can_id, n: the frame was lost
    corruption                              the same; with bit (of the data) it went on damaged after delay_ns
    duplicate                               the same, delay_ns, and later_ns for the second one
    reorder                                 the same, delay_ns, then held_ns in which others overtake it
    delay                                   the same, delay_ns; in_order false: it may overtake others
    error_frame                             the same, of attempts to send; bit on the wire
    signal_stuck, signal_offset ..          at_ns, direction, can_id, n; object as the upper 24 bits of a
                                            mapping word; bits_at, its length times 64 plus its first bit; raw
    signal_nowhere                          the frame at which it was noticed; object, node (0: any)
    silence, bus_off, drive_fault,          at_ns, node, and what happens
    clock_step, clock_drift, lss_yes_sayer,
    mode_change, ignored_commands,
    repeated_emergency
    late, boot                              a slow drive: node, can_id, n, delay_ns; at_ns since its power-on,
                                            in a recording since the first cycle, as everywhere
    refused_mapping                         at_ns (the same), node, abort; parameter and mapped as the upper
                                            24 bits of a mapping word
    host_stall                              at_ns, n and late_ns: the host's n-th action came so much later
    full_queue, link_down,                  at_ns and duration_ns: the host's adapter
    receive_overflow

A frame that was struck at a drive's own connection bears side ("drive") and node as well, and n counts there.
"""

import json
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

from servobench.drivers.bounded_file import parse_json
from servobench.drivers.errors import BadInput
from servobench.drivers.wire.frame_port import EXTENDED_FLAG, EXTENDED_ID_MAX, STANDARD_ID_MAX
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.core import native
from servobench.virtual_bus.faults.fault_table import NONE, LogNumber
from servobench.virtual_bus.faults.register import LOG_KINDS

KINDS = tuple(kind.name for kind in LOG_KINDS)
KIND_CODES = {kind: code for code, kind in enumerate(KINDS)}
FRAME_KINDS, NODE_KINDS, HOST_KINDS = (
    tuple(kind.name for kind in LOG_KINDS if kind.at == at) for at in ("link", "node", "host")
)
_DELAY: Final = KIND_CODES["delay"]
_LABELS: Final = tuple(direction.label for direction in Direction)
_DELAY_LINE: Final = '{"kind":"delay","at_ns":%d,"direction":"%s","can_id":%d,"n":%d,"delay_ns":%d}'
"""Format of nearly all entries of a run, without a dictionary."""
_COMPACT: Final = (",", ":")
AT_NODE: Final = len(Direction)
"""A frame's link at a drive's own connection is its direction plus so many times the drive's node id."""

_ENTRY: Final = struct.Struct("=8q")
BLOCK_BYTES: Final = native.BLOCK_ENTRIES * _ENTRY.size
BLOCK: Final = struct.Struct(f"<I{BLOCK_BYTES}s")
"""A row of the ring between the run and whoever writes: how much of the block is filled, and the block."""


class FaultEntry(NamedTuple):
    """One thing that was injected."""

    at_ns: int
    a: int
    b: int
    c: int
    can_id: int
    n: int
    code: int
    """Index into KINDS."""
    link: int
    """Direction of a frame, with the drive's node id (AT_NODE) at its own connection; else a node id."""

    @property
    def kind(self) -> str:
        """Its name in KINDS."""
        return KINDS[self.code]

    @property
    def direction(self) -> Direction:
        """Direction of a frame."""
        return Direction(self.link % AT_NODE)

    @property
    def at_drive(self) -> int:
        """The node at whose connection a frame was struck; 0 at the host's."""
        return self.link // AT_NODE


class FaultLog(native.EntryBlock):
    """Collects entries into blocks for a sink, in the order of injection; without a sink it keeps them."""

    def __init__(self) -> None:
        self._waiting: list[bytes] = []
        self._sink: Callable[[int, bytes], object] | None = None

    def send_to(self, sink: Callable[[int, bytes], object]) -> None:
        """From now on every block goes to ``sink(bytes filled, block)``, those that wait at once."""
        self._sink = sink
        for data in self._waiting:
            sink(len(data), data)
        self._waiting.clear()

    def flush(self) -> None:
        """Let the sink have what has been collected."""
        data = self.take()
        if not data:
            return
        if self._sink is None:
            self._waiting.append(data)
        else:
            self._sink(len(data), data)

    def entries(self) -> list[FaultEntry]:
        """All that is kept here, for want of a sink."""
        self.flush()
        return [entry for data in self._waiting for entry in entries_of(data)]


def entries_of(block: bytes) -> Iterator[FaultEntry]:
    """The entries in the filled part of a block."""
    return map(FaultEntry._make, _ENTRY.iter_unpack(block))


def entry_line(entry: FaultEntry) -> str:
    """One line of JSON, without its end."""
    if entry.code == _DELAY and entry.b and entry.can_id <= STANDARD_ID_MAX and entry.link < AT_NODE:
        at_ns, delay_ns, _, _, can_id, n, _, link = entry
        return _DELAY_LINE % (at_ns, _LABELS[link], can_id, n, delay_ns)
    kind = LOG_KINDS[entry.code]
    line: dict[str, Any] = {"kind": kind.name, "at_ns": entry.at_ns}
    if kind.at == "node":
        line["node"] = entry.link
    elif kind.at == "link":
        line["direction"] = entry.direction.label
        if entry.at_drive:
            line |= {"side": "drive", "node": entry.at_drive}
    if kind.tells == "frame":
        line["can_id"] = entry.can_id & ~EXTENDED_FLAG
        if entry.can_id & EXTENDED_FLAG:
            line["extended"] = True
    if kind.tells != "nothing":
        line["n"] = entry.n
    if entry.a != NONE or not any(number.optional for number in kind.numbers):
        for number, value in zip(kind.numbers, (entry.a, entry.b, entry.c), strict=False):
            if value != number.usual:
                line[number.name] = number.words[value] if number.words else value
    return json.dumps(line, separators=_COMPACT)


def read_line(text: str, source: str, line: int) -> FaultEntry:
    """Inverse of :func:`entry_line`; ``line``: its number in the file ``source``. Raises BadInput."""
    place = f"line {line}"
    fields = parse_json(text, source, "a line of a recorded run's faults", place)
    if not isinstance(fields, dict) or fields.get("kind") not in KIND_CODES:
        value = fields.get("kind") if isinstance(fields, dict) else fields
        raise BadInput(
            source,
            place,
            type(value).__name__ if isinstance(value, dict | list) else value,
            f"an object whose kind is one of {', '.join(KINDS)}",
        )
    return _Line(fields, source, place).entry()


class _Line:
    """Takes the fields out of one line's object."""

    def __init__(self, fields: Mapping[str, Any], source: str, place: str) -> None:
        self._fields = fields
        self._source = source
        self._place = place

    def entry(self) -> FaultEntry:
        code = KIND_CODES[self._fields["kind"]]
        kind = LOG_KINDS[code]
        can_id = n = link = 0
        if kind.tells == "frame":
            extended = self._fields.get("extended", False) is True
            can_id = self._whole("can_id", 0, EXTENDED_ID_MAX if extended else STANDARD_ID_MAX)
            can_id |= EXTENDED_FLAG if extended else 0
        if kind.tells != "nothing":
            n = self._whole("n", 0, 2**32 - 1)
        if kind.at == "link":
            link = self._link()
        elif kind.at == "node":
            link = self._whole("node", 1, 127)
        at_ns = self._whole("at_ns", -(2**62), 2**62)
        a, b, c = self._numbers(kind.numbers)
        return FaultEntry(at_ns, a, b, c, can_id, n, code, link)

    def _numbers(self, numbers: tuple[LogNumber, ...]) -> list[int]:
        if numbers and numbers[0].optional and numbers[0].name not in self._fields:
            return [NONE, 0, 0]
        return [self._number(number) for number in numbers] + [0] * (3 - len(numbers))

    def _number(self, number: LogNumber) -> int:
        unsaid = number.unsaid if number.usual is None else number.usual
        if unsaid is not None and number.name not in self._fields:
            return unsaid
        return (
            self._one_of(number.name, number.words)
            if number.words
            else self._whole(number.name, number.least, 2**62)
        )

    def _link(self) -> int:
        direction = self._one_of("direction", _LABELS)
        if "side" not in self._fields:
            return direction
        if self._fields["side"] != "drive":
            raise self._bad("side", "drive, or no side")
        return direction + AT_NODE * self._whole("node", 1, 127)

    def _one_of(self, name: str, words: tuple[bool | str, ...]) -> int:
        """The number that a word stands for."""
        value = self._fields.get(name)
        if value not in words:
            raise self._bad(name, f"one of {', '.join(map(str, words))}")
        return words.index(value)

    def _whole(self, name: str, least: int, most: int) -> int:
        value = self._fields.get(name)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise self._bad(name, f"a whole number from {least} to {most}")
        return value

    def _bad(self, name: str, expected: str) -> BadInput:
        return BadInput(self._source, f"{self._place}: {name}", self._fields.get(name), expected)
