"""What a scope saw, as files: samples as CSV, a picture, and a page."""

import csv
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.drivers.written_file import writing, written
from servobench.hil.inspecting.scope import Channel
from servobench.hil.reviewing.html_page import html_page, html_table

SAMPLES: Final = "samples.csv"
_PICTURE, _PAGE = "scope.png", "scope.html"
_COLUMNS: Final = ("time_s", "within_s", "object", "name", "value", "unit", "source")
_FIGURES: Final = (
    *("object", "name", "unit", "source", "samples", "rate_hz", "gap_s", "within_s"),
    *("min", "mean", "max", "lack"),
)
_BLUE, _GRID = "#1f5fa8", "#e3e6ea"
_ROW_INCHES = 1.7
_POINTS = 400
"""With fewer each sample is marked: lines alone hide how few there are."""


def make_folder(folder: Path) -> None:
    """Make the folder. Raises BadInput where it cannot be, or has one of the files."""
    for name in (SAMPLES, _PICTURE, _PAGE):
        if (folder / name).exists():
            raise BadInput("--out", "", str(folder / name), "a folder without one")
    with writing("--out", folder):
        folder.mkdir(parents=True, exist_ok=True)


def write_scope(folder: Path, channels: Sequence[Channel], title: str) -> list[Path]:
    """Write the files and return them. Raises BadInput for a folder that cannot be written."""
    make_folder(folder)
    seen = [each for each in channels if each.values]
    origin = min((each.at[0] for each in seen), default=Instant(0))
    files = [folder / SAMPLES]
    with written("--out", files[0]) as path:
        _write_samples(path, seen, origin)
    parts = [f"<h1>{escape(title)}</h1>"]
    if seen:
        files.append(folder / _PICTURE)
        _draw(files[-1], seen, origin)
        parts.append(f"<figure><img src='{_PICTURE}' alt='values over time'></figure>")
    rows = [each.as_json() for each in channels]
    parts.append(html_table(_FIGURES, ([row.get(name, "") for name in _FIGURES] for row in rows)))
    files.append(folder / _PAGE)
    with written("--out", files[-1]) as path:
        path.write_text(html_page(title, parts), encoding="utf-8")
    return files


def _write_samples(path: Path, channels: Sequence[Channel], origin: Instant) -> None:
    """Write one row for each sample, the oldest first; times from ``origin`` on."""
    samples = sorted(
        (at, number, within, value)
        for number, each in enumerate(channels)
        for at, within, value in zip(each.at, each.within, each.values, strict=True)
    )
    with path.open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(_COLUMNS)
        for at, number, within, value in samples:
            each = channels[number]
            times = f"{(at - origin) / NS_PER_S:.9f}", f"{within / NS_PER_S:.9f}"
            rows.writerow([*times, object_name(*each.key), each.name, repr(value), each.unit, each.source])


def _draw(path: Path, channels: Sequence[Channel], origin: Instant) -> None:
    """Draw an axis for each object."""
    figure = Figure(figsize=(9.0, _ROW_INCHES * len(channels) + 0.5), layout="constrained")
    rows = np.atleast_1d(figure.subplots(len(channels), 1, sharex=True))
    for ax, each in zip(rows, channels, strict=True):
        time = (np.array(each.at) - origin) / NS_PER_S
        marker = "." if len(time) < _POINTS else ""
        ax.plot(time, each.values, color=_BLUE, linewidth=0.9, marker=marker, markersize=3.0)
        unit = f", {each.unit}" if each.unit else ""
        title = f"{each.title}{unit} ({each.source}, {each.rate_hz:.4g} a second)"
        ax.set_title(title, loc="left", fontsize="small")
        ax.grid(color=_GRID, linewidth=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    rows[-1].set_xlabel("s")
    figure.savefig(path, dpi=110)
