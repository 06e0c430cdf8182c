"""A Rerun page as text: its layout, what stands in it for all time, and of every series a few rows and its
ends."""

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from rerun.chunk import RrdReader

from servobench.drivers.timebase import NS_PER_S

TIMELINE: Final = "run_time"
_LEFT_OUT: Final = {
    "ActiveVisualizers:instruction_ids",
    "rerun.controls.RowId",
    "log_time",
    "log_tick",
    "blueprint",
    TIMELINE,
}
_UUID: Final = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
Row = tuple[int, str, str, str]
"""When sent, on which entity, what, as text."""
_ROWS: Final = 5
_WALL_TIME: Final = re.compile(r"comput")
"""Series that no two runs have in common."""


def page_text(page: Path) -> str:
    """Its blueprints in the order in which they were sent, like ones once, then its data by name."""
    reader = RrdReader(page)
    layouts = sorted(_sent(reader.stream(store=store)) for store in reader.blueprints())
    texts = dict.fromkeys("\n".join(_layout(layout)) for layout in layouts)
    return "\n".join([*texts, *_data(reader.stream()), ""])


def _sent(chunks: Iterable[Any]) -> list[Row]:
    rows = []
    for chunk in chunks:
        batch = chunk.to_record_batch()
        if "log_time" not in batch.schema.names:
            continue
        stamps = batch.column("log_time").cast("int64").to_pylist()
        for name in set(batch.schema.names) - _LEFT_OUT:
            values = map(_said, batch.column(name).to_pylist())
            rows += [
                (at, str(chunk.entity_path), name, value) for at, value in zip(stamps, values, strict=True)
            ]
    return sorted(rows)


def _layout(rows: list[Row]) -> Iterator[str]:
    number = _numbering()
    for _, entity, name, value in rows:
        if name != "ViewportBlueprint:root_container":
            yield _UUID.sub(number, f"{entity} {name} {value}")


def _numbering() -> Callable[[re.Match[str]], str]:
    seen: dict[str, str] = {}
    return lambda match: seen.setdefault(match[0], f"n{len(seen)}")


def _data(chunks: Iterable[Any]) -> Iterator[str]:
    held: dict[tuple[str, str], list[tuple[int, Any]]] = defaultdict(list)
    for chunk in chunks:
        batch, entity = chunk.to_record_batch(), str(chunk.entity_path)
        if entity.startswith("/__") or _WALL_TIME.search(entity):
            continue
        names = batch.schema.names
        moving = TIMELINE in names
        times = batch.column(TIMELINE).cast("int64").to_pylist() if moving else [0] * batch.num_rows
        for name in set(names) - _LEFT_OUT:
            held[entity, name if moving else f"{name} for all time"] += zip(
                times, batch.column(name).to_pylist(), strict=True
            )
    for (entity, name), rows in sorted(held.items()):
        is_event = name.startswith("TextLog:text") and not name.endswith(" for all time")
        # events of one instant have no order of their own
        yield from _series(
            f"{entity} {name}", sorted(rows, key=lambda row: (row[0], row[1][0] if is_event else ""))
        )


def _series(name: str, rows: list[tuple[int, Any]]) -> Iterator[str]:
    if name.endswith(" for all time"):
        yield f"{name}: {_said(rows[-1][1])}"
        return
    yield f"{name}: {len(rows)} rows"
    if isinstance(rows[0][1], list) and rows[0][1] and isinstance(rows[0][1][0], float):
        values = np.array([value for _, value in rows], float)
        if not np.isnan(values).all(axis=0).any():
            ends = np.nanmin(values, axis=0), np.nanmax(values, axis=0), np.nanmean(values, axis=0)
            yield "  least, largest, mean: " + " ".join(_said(end.tolist()) for end in ends)
    shown = rows if len(rows) <= _ROWS or isinstance(rows[0][1][0], str) else rows[:: len(rows) // _ROWS + 1]
    for at_ns, value in [*shown, rows[-1]]:
        yield f"  {at_ns / NS_PER_S:.6f} s {_said(value)}"


def _said(value: Any) -> str:
    """In a line; numbers in six digits."""
    if isinstance(value, list):
        return _said(value[0]) if len(value) == 1 else f"[{', '.join(map(_said, value))}]"
    if isinstance(value, dict):
        return f"({', '.join(f'{key} {_said(each)}' for key, each in value.items())})"
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)
