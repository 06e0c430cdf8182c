"""A run as a figure for a paper or a report: speed, error, torque and delay, by matplotlib."""

import io
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.drivers.written_file import written
from servobench.hil.recorded.recorded_run import RunSignals

SUFFIXES: Final = (".svg", ".pdf", ".png")
_COLORS: Final = ("#1f5fa8", "#2e7d32", "#c2571a", "#6a4fa0")
_GREY, _RED, _GRID = "#7a7f87", "#c8442c", "#e3e6ea"
_PLOTS: Final = (
    ("speed", "Speed [r/min]", ("speed/reference", "speed/measured")),
    ("error", "Speed error [r/min]", ("error/error",)),
    ("torque", "Torque [N m]", ("torque/load", "torque/measured")),
    ("delay", "Delay [us]", ("delay/delay",)),
)
_BESIDE: Final = ("speed/reference", "torque/load")
"""Drawn in grey: what was asked for."""


def paper_figure(run: RunSignals, begin_s: float | None = None, end_s: float | None = None) -> Figure:
    """Four plots over one time axis, those of all axes in each; light, for print."""
    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(_PLOTS), 1, sharex=True, height_ratios=[2, 1.3, 1.5, 1.2])
    for ax, (plot, title, paths) in zip(axes, _PLOTS, strict=True):
        for place, name in enumerate(run.axes):
            for path in paths:
                _draw(ax, run, name, path, _COLORS[place % len(_COLORS)])
        _limits(ax, run, plot)
        ax.set_ylabel(title, fontsize="small")
        ax.grid(color=_GRID, linewidth=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].legend(fontsize="x-small", loc="best", frameon=False)
    axes[-1].set_xlabel("time since the first cycle [s]", fontsize="small")
    axes[-1].set_xlim(begin_s, end_s)
    figure.align_ylabels(axes)
    return figure


def _draw(ax: Any, run: RunSignals, name: str, path: str, color: str) -> None:
    envelope = run.signals.get(f"{name}/{path}")
    if envelope is None:
        return
    times, values = envelope.points()
    word = path.partition("/")[2]
    of = f"{name}: " if len(run.axes) > 1 else ""
    beside = path in _BESIDE
    ax.plot(
        times / NS_PER_S,
        values,
        color=_GREY if beside else color,
        linewidth=0.9 if beside else 0.8,
        drawstyle="steps-post" if beside else "default",
        label=None if beside and name != run.axes[0] else (word if beside else of + word),
    )


def _limits(ax: Any, run: RunSignals, plot: str) -> None:
    if plot == "delay":
        ax.axhline(run.deadline_ns / NS_PER_US, color=_RED, linewidth=0.8, linestyle="--")
        ax.set_ylim(bottom=0)
    if plot == "error":
        limits = [limit for limit in run.error_limits_rpm.values() if limit is not None]
        reach = max(limits, default=0.0)
        counted = max(run.counted_error_rpm.values(), default=0.0)
        for sign in (1.0, -1.0) if limits else ():
            ax.axhline(sign * reach, color=_RED, linewidth=0.8, linestyle="--")
        if most := max(reach, counted):
            ax.set_ylim(-1.4 * most, 1.4 * most)


def histogram_figure(run: RunSignals) -> Figure:
    """Delays of each axis with the deadline."""
    figure = Figure(figsize=(7.2, 1.1 + 1.2 * len(run.axes)), layout="constrained")
    FigureCanvasAgg(figure)
    for ax, name in zip(np.atleast_1d(figure.subplots(len(run.axes), 1, sharex=True)), run.axes, strict=True):
        delays = run.delays[name]
        largest = delays.largest_ns
        if largest is not None:
            width = max(1_000, largest // 60)
            counts = delays.bars(width, largest // width + 1)
            edges_us = np.arange(counts.size + 1) * width / NS_PER_US
            ax.stairs(counts, edges_us, fill=True, color=_COLORS[0])
        ax.axvline(run.deadline_ns / NS_PER_US, color=_RED, linewidth=0.9, linestyle="--")
        ax.set_yscale("symlog")
        ax.set_ylabel(name, fontsize="small")
        ax.spines[["top", "right"]].set_visible(False)
    ax.set_xlabel("delay of the readings [us]; dashed: the deadline", fontsize="small")
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Raises BadInput for a path that ends otherwise or cannot be written to, DiskFull."""
    if path.suffix not in SUFFIXES:
        raise BadInput("OUT", "", str(path), f"a file that ends in {', '.join(SUFFIXES)}")
    with written("OUT", path) as place, mpl.rc_context({"svg.hashsalt": "servobench"}):
        figure.savefig(place, dpi=150, metadata={"Date": None} if path.suffix == ".svg" else None)


def svg_text(figure: Figure) -> str:
    """To be put into a page."""
    text = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "servobench"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]
