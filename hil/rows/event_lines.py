"""The entries of events.jsonl."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from servobench.drivers.bounded_file import parse_json
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Instant
from servobench.hil.rows.run_files import EVENTS_FILE
from servobench.hil.rows.side_rows import BeginEvent, StateEvent, TextEvent


def event_json(event: TextEvent | StateEvent | BeginEvent, zero: Instant) -> dict[str, object]:
    """Return an entry of events.jsonl; ``zero``: the first cycle."""
    at = {"at_ns": event.at - zero}
    if isinstance(event, TextEvent):
        return {**at, "level": event.level, "text": event.text}
    if isinstance(event, BeginEvent):
        return {**at, "begin": True}
    return {**at, "track": event.track, "state": event.label}


def read_events(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the entries of an events.jsonl; an invalid one, such as a truncated line, is skipped."""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        with suppress(BadInput):
            event = parse_json(line, EVENTS_FILE, "an event")
            if isinstance(event, dict) and isinstance(event.get("at_ns"), int):
                yield event
