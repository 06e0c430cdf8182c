"""The entries of events.jsonl."""

from drivers.timebase import Instant
from hil.rows.side_rows import BeginEvent, StateEvent, TextEvent


def event_json(event: TextEvent | StateEvent | BeginEvent, zero: Instant) -> dict[str, object]:
    """An entry of events.jsonl; ``zero``: the first cycle."""
    at = {"at_ns": event.at - zero}
    if isinstance(event, TextEvent):
        return {**at, "level": event.level, "text": event.text}
    if isinstance(event, BeginEvent):
        return {**at, "begin": True}
    return {**at, "track": event.track, "state": event.label}
