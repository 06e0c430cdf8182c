"""Matplotlib figures as text: titles, axes, limits, legends, and of every line a few points."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import matplotlib.colors
import numpy as np
from matplotlib.figure import Figure

_POINTS: Final = 6


@contextmanager
def drawn() -> Iterator[list[str]]:
    """What is saved while the context lasts, a text a figure; nothing but an empty file is written."""
    texts: list[str] = []

    def save(figure: Figure, path: Any, **options: Any) -> None:
        Path(path).touch()
        texts.append(figure_text(Path(path).name, figure, options))

    with patch.object(Figure, "savefig", save):
        yield texts


def figure_text(name: str, figure: Figure, options: dict[str, Any]) -> str:
    """Of one figure, however it is to be saved."""
    lines = [f"picture {name}, {_row(figure.get_size_inches())} inch, {sorted(map(str, options.items()))}"]
    for axis in figure.axes:
        limits = f"x {_row(axis.get_xlim())}, y {_row(axis.get_ylim())}"
        lines.append(
            f"axis {axis.get_title()!r} {axis.get_xlabel()!r} {axis.get_xscale()} "
            f"{axis.get_ylabel()!r} {axis.get_yscale()}, {limits}"
        )
        legend = axis.get_legend()
        if legend is not None:
            lines.append(f"  legend {[text.get_text() for text in legend.get_texts()]}")
        lines += [f"  text {text.get_text()!r} at {_row(text.get_position())}" for text in axis.texts]
        for line in axis.lines:
            style = f"{line.get_linestyle()} {line.get_marker()} {line.get_linewidth():g}"
            color = matplotlib.colors.to_hex(line.get_color(), keep_alpha=True)
            lines.append(f"  line {line.get_label()!r} {color} {style}")
            lines += _points(np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float))
        for patch_ in axis.patches:
            box = patch_.get_extents().transformed(axis.transData.inverted())
            lines.append(f"  patch {patch_.get_label()!r} {_row(box.extents)}")
        for collection in axis.collections:
            shade = [matplotlib.colors.to_hex(each) for each in np.atleast_2d(collection.get_facecolor())]
            lines.append(f"  collection {collection.get_label()!r} {shade} {len(collection.get_paths())}")
    return "\n".join(lines) + "\n"


def _points(x: np.ndarray, y: np.ndarray) -> Iterator[str]:
    there = y[np.isfinite(y)]
    yield f"    {len(x)} points, {len(there)} of them drawn"
    if len(there):
        yield f"    least, largest, mean {_row([there.min(), there.max(), there.mean()])}"
    for place in np.unique(np.linspace(0, len(x) - 1, _POINTS).round().astype(int)) if len(x) else ():
        yield f"    {_row([x[place], y[place]])}"


def _row(values: Any) -> str:
    return " ".join(f"{value:.5g}" for value in values)
