"""One line of a decoded bus, and which lines somebody wants to see."""

import math
from collections.abc import Iterable, Iterator
from typing import Any, Final, NamedTuple

from servobench.drivers.timebase import NS_PER_S
from servobench.hil.reviewing.trace.frame_columns import EVER_NS, LogWindow
from servobench.hil.reviewing.trace.object_value import ObjectValue

KINDS: Final = ("nmt", "sync", "emcy", "time", "heartbeat", "guarding", "sdo", "pdo", "lss", "error", "other")


class TraceEntry(NamedTuple):
    """Content of a frame, or of the frames of one SDO transfer."""

    at_ns: int | None
    """Time of its last frame, as the log counts; None where the log has no times."""
    began_ns: int | None
    """Time of its first frame."""
    first: int
    """Line or packet of the first frame."""
    last: int
    frames: int
    """More than one for an SDO transfer only; frames of others may lie between them."""
    channel: str
    can_id: int
    """Identifier of the last frame."""
    sent: str
    """Who sent the last frame: T the bench or who logged, R another; empty if the log does not tell."""
    kind: str
    """One of KINDS."""
    node: int | None
    """None where no single node is meant."""
    text: str
    values: tuple[ObjectValue, ...] = ()
    data: bytes = b""
    """Data of the frame; for an SDO transfer its value."""
    details: tuple[tuple[str, Any], ...] = ()
    """Further details of the kind, for programs."""

    def as_json(self, zero_ns: int) -> dict[str, Any]:
        """Plain values; ``at_s`` and ``began_s`` count from ``zero_ns``, ``stamp_ns`` as the log."""
        at, began = self.at_ns, self.began_ns
        told: dict[str, Any] = {
            "at_s": None if at is None else (at - zero_ns) / 1e9,
            "stamp_ns": at,
            "kind": self.kind,
            "node": self.node,
            "can_id": self.can_id,
            "channel": self.channel,
            "sent": self.sent or None,
            "frame": self.last,
            "text": self.text,
            "data": self.data.hex(),
        }
        if self.frames > 1:
            told |= {
                "began_s": None if began is None else (began - zero_ns) / 1e9,
                "first_frame": self.first,
                "frames": self.frames,
            }
        if self.values:
            told["values"] = [value.as_json() for value in self.values]
        return told | dict(self.details)


class TraceSelection(NamedTuple):
    """Everything, unless told otherwise."""

    node: int | None = None
    """Its lines, and NMT commands to all nodes."""
    kinds: frozenset[str] = frozenset()
    """Empty: all."""
    from_s: float | None = None
    to_s: float | None = None

    def of(self, entries: Iterable[TraceEntry], zero_ns: int) -> Iterator[TraceEntry]:
        """Those that are wanted; ``zero_ns``: what the times count from."""
        for entry in entries:
            if self.kinds and entry.kind not in self.kinds:
                continue
            for_all = entry.kind == "nmt" and entry.node is None
            if self.node is not None and entry.node != self.node and not for_all:
                continue
            if self._in_time(entry, zero_ns):
                yield entry

    def window(self, zero_ns: int) -> LogWindow | None:
        """The same times as a log counts; None: all of it is wanted."""
        if self.from_s is None and self.to_s is None:
            return None
        begin = -EVER_NS if self.from_s is None else zero_ns + math.floor(self.from_s * NS_PER_S)
        end = EVER_NS if self.to_s is None else zero_ns + math.ceil(self.to_s * NS_PER_S)
        return LogWindow(begin, end)

    def _in_time(self, entry: TraceEntry, zero_ns: int) -> bool:
        if self.from_s is None and self.to_s is None:
            return True
        if entry.at_ns is None:
            return False
        at_s = (entry.at_ns - zero_ns) / NS_PER_S
        return (self.from_s is None or at_s >= self.from_s) and (self.to_s is None or at_s <= self.to_s)
