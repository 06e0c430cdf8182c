"""Rows of the two small rings beside the cycle records: raw frames, and events with their text."""

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import Instant
from servobench.hil.core.native import frame_row as frame_row

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
number of the segment, 0 for the first. ``frame_row`` (core/frame_row.c) packs one."""


LEVELS: tuple[str, ...] = ("INFO", "WARN", "ERROR", "CRITICAL")

TEXT_BYTES: Final = 500
"""With it a row has 512."""
EVENT: Final = struct.Struct(f"<qBBH{TEXT_BYTES}s")
EVENT_DTYPE: Final = np.dtype(
    [("at", "<i8"), ("kind", "u1"), ("level", "u1"), ("length", "<u2"), ("text", "u1", (TEXT_BYTES,))]
)
_SEPARATOR: Final = "\x1f"


class TextEvent(NamedTuple):
    """A noteworthy event."""

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
    """The identity reported by the drive of an axis."""

    at: Instant
    axis: str
    text: str


RunEvent = TextEvent | StateEvent | BeginEvent | LoadEvent | IdentityEvent
EVENTS: tuple[type[RunEvent], ...] = (TextEvent, StateEvent, BeginEvent, LoadEvent, IdentityEvent)
"""A row's kind is the place of its event's class here."""


def drives_of(events: Sequence[RunEvent]) -> dict[str, str]:
    """Return the identity of each axis' drive."""
    return {event.axis: event.text for event in events if isinstance(event, IdentityEvent)}


def event_row(event: RunEvent) -> bytes:
    """Return a row of EVENT. A text beyond TEXT_BYTES is cut at a whole character."""
    if isinstance(event, TextEvent):
        level, text = LEVELS.index(event.level), event.text
    else:
        level, text = 0, _SEPARATOR.join([str(field) for field in event[1:]])
    encoded = text.encode("utf-8", "replace")[:TEXT_BYTES].decode("utf-8", "ignore").encode()
    return EVENT.pack(event.at, EVENTS.index(type(event)), level, len(encoded), encoded)


def events_of(rows: NDArray[np.void]) -> list[RunEvent]:
    """Return the events in rows of EVENT_DTYPE: inverse of :func:`event_row`."""
    return [_event_of(row) for row in rows]


def _event_of(row: np.void) -> RunEvent:
    at, kind = Instant(int(row["at"])), EVENTS[int(row["kind"])]
    text = row["text"].tobytes()[: int(row["length"])].decode()
    if kind is TextEvent:
        return TextEvent(at, LEVELS[int(row["level"])], text)
    if kind is BeginEvent:
        return BeginEvent(at)
    name, _, told = text.partition(_SEPARATOR)
    if kind is LoadEvent:
        torque_nm, _, speed_rad_s = told.partition(_SEPARATOR)
        return LoadEvent(at, name, float(torque_nm), float(speed_rad_s))
    return StateEvent(at, name, told) if kind is StateEvent else IdentityEvent(at, name, told)
