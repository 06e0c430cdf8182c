"""Rows of the two small rings beside the cycle records: raw frames, and events with their text."""

import struct
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from librt.strings import BytesWriter, write_i64_le
from numpy.typing import NDArray

from drivers.timebase import Instant

EXTENDED_FLAG: Final = 1 << 31
REMOTE_FLAG: Final = 1 << 30
"""Flags beside the identifier, at the places where SocketCAN has them (struct can_frame)."""

FRAME: Final = struct.Struct("<qIBBxx8s")
FRAME_DTYPE: Final = np.dtype(
    {
        "names": ["at", "can_id", "length", "sent", "data"],
        "formats": ["<i8", "<u4", "u1", "u1", ("u1", (8,))],
        "offsets": [0, 8, 12, 13, 16],
        "itemsize": FRAME.size,
    }
)
"""``sent``: bit 0 is 1 for a frame that the bench sent, 0 for one that it received; the bits above it are the
number of the segment, 0 for the first."""


def frame_row(at: Instant, can_id: int, sent: int, data: bytes) -> bytes:
    """A row of FRAME; ``can_id`` with its flags."""
    row = BytesWriter()
    write_i64_le(row, at)
    write_i64_le(row, can_id | len(data) << 32 | sent << 40)
    row.write(data)
    for _ in range(8 - len(data)):
        row.append(0)
    return row.getvalue()


class EventKind(IntEnum):
    """What a row of the event ring is about."""

    TEXT = 0
    """Its text is for the reader; its level is an index into LEVELS."""
    STATE = 1
    """Its text is a track and the state that the track is in from now on."""
    BEGIN = 2
    """Its instant is the run's time zero."""
    LOAD = 3
    """Its text is an axis and what its load machine measured."""
    IDENTITY = 4
    """Its text is an axis and who its drive is."""


LEVELS: tuple[str, ...] = ("INFO", "WARN", "ERROR", "CRITICAL")

TEXT_BYTES: Final = 500
"""With it a row has 512."""
EVENT: Final = struct.Struct(f"<qBBH{TEXT_BYTES}s")
EVENT_DTYPE: Final = np.dtype(
    [("at", "<i8"), ("kind", "u1"), ("level", "u1"), ("length", "<u2"), ("text", "u1", (TEXT_BYTES,))]
)
_SEPARATOR: Final = "\x1f"


class TextEvent(NamedTuple):
    """Something worth reading."""

    at: Instant
    level: str
    text: str


class StateEvent(NamedTuple):
    """A track enters a state."""

    at: Instant
    track: str
    label: str


class BeginEvent(NamedTuple):
    """The run's time zero."""

    at: Instant


class LoadEvent(NamedTuple):
    """A load machine measured."""

    at: Instant
    axis: str
    torque_nm: float
    speed_rad_s: float


class IdentityEvent(NamedTuple):
    """The drive of an axis has told who it is."""

    at: Instant
    axis: str
    text: str


RunEvent = TextEvent | StateEvent | BeginEvent | LoadEvent | IdentityEvent


def event_row(event: RunEvent) -> bytes:
    """A row of EVENT. A text beyond TEXT_BYTES is cut at a whole character."""
    if isinstance(event, TextEvent):
        kind, level, text = EventKind.TEXT, LEVELS.index(event.level), event.text
    elif isinstance(event, StateEvent):
        kind, level, text = EventKind.STATE, 0, event.track + _SEPARATOR + event.label
    elif isinstance(event, LoadEvent):
        values = f"{event.torque_nm!r}{_SEPARATOR}{event.speed_rad_s!r}"
        kind, level, text = EventKind.LOAD, 0, f"{event.axis}{_SEPARATOR}{values}"
    elif isinstance(event, IdentityEvent):
        kind, level, text = EventKind.IDENTITY, 0, event.axis + _SEPARATOR + event.text
    else:
        kind, level, text = EventKind.BEGIN, 0, ""
    encoded = text.encode("utf-8", "replace")[:TEXT_BYTES].decode("utf-8", "ignore").encode()
    return EVENT.pack(event.at, kind, level, len(encoded), encoded)


def events_of(rows: NDArray[np.void]) -> list[RunEvent]:
    """The events in rows of EVENT_DTYPE: inverse of :func:`event_row`."""
    return [_event_of(row) for row in rows]


def _event_of(row: np.void) -> RunEvent:
    at, kind = Instant(int(row["at"])), EventKind(int(row["kind"]))
    text = row["text"].tobytes()[: int(row["length"])].decode()
    if kind is EventKind.TEXT:
        return TextEvent(at, LEVELS[int(row["level"])], text)
    if kind is EventKind.STATE:
        track, _, label = text.partition(_SEPARATOR)
        return StateEvent(at, track, label)
    if kind is EventKind.LOAD:
        axis, torque_nm, speed_rad_s = text.split(_SEPARATOR)
        return LoadEvent(at, axis, float(torque_nm), float(speed_rad_s))
    if kind is EventKind.IDENTITY:
        axis, _, identity = text.partition(_SEPARATOR)
        return IdentityEvent(at, axis, identity)
    return BeginEvent(at)
