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
from servobench.hil.recording.row_series import READ_SERIES
from servobench.hil.recording.whole_figures import in_view

SUFFIXES: Final = (".svg", ".pdf", ".png")
_COLORS: Final = ("#1f5fa8", "#fcaa00", "#543afa", "#000000")
_GREY, _RED, _GRID, _SHADE = "#8e9094", "#b92308", "#e3e6ea", "#eceef1"
"""Axes, what was asked, and limits are 40 apart (CIELAB) under protanopia and deuteranopia too."""
_PLOTS: Final = (
    ("speed", "Speed [r/min]", ("speed/reference", "speed/measured"), 2.0),
    ("error", "Speed error [r/min]", ("error/error",), 1.3),
    ("position", "Position [rad]", ("position/reference", "position/measured"), 2.0),
    ("position_error", "Position error [rad]", ("position_error/error",), 1.3),
    ("torque", "Torque [N m]", ("torque/load", "torque/measured"), 1.5),
    ("delay", "Delay [us]", ("delay/delay",), 1.2),
)
"""With their heights, beside each other's."""
_INCHES: Final = 6.4 / 6.0
"""Height of a plot of height 1, with its share of margins."""
_RUG: Final = 0.035
"""Height of the marks of dropouts, as a share of the plot's."""
_RUG_WIDTH: Final = 0.6
"""Least width of a mark, pt: a lost cycle is seen in an hour."""


def paper_figure(run: RunSignals, since: str = "the first cycle") -> Figure:
    """Speed and position, as axes are given them, each with its error, torque and delay over one time axis.

    Light, for print. What was read is interrupted where no reading came, and each dropout is marked. An
    error's limit is drawn where it is judged; where an error is not counted the plot is shaded. Times count
    from ``since``.
    """
    plots = [each for each in _PLOTS if run.axes_in(each[0])]
    heights = [height for _, _, _, height in plots]
    figure = Figure(figsize=(7.2, _INCHES * sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(plots), 1, sharex=True, height_ratios=heights)
    for ax, (plot, title, paths, _) in zip(axes, plots, strict=True):
        for name in run.axes_in(plot):
            for path in paths:
                _draw(ax, run, name, path)
        if "error" in plot:
            _draw_judged(ax, run, plot)
        ax.set_ylabel(title, fontsize="small")
        ax.grid(color=_GRID, linewidth=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    _mark_dropouts(axes[0], run)
    _draw_deadline(axes[-1], run)
    for ax in axes:
        ax.legend(fontsize="x-small", loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    axes[-1].set_xlabel(f"time since {since} [s]", fontsize="small")
    axes[-1].set_xlim(*run.window_s)
    figure.align_ylabels(axes)
    return figure


def _has_points(run: RunSignals, path: str) -> bool:
    return path in run.signals and run.signals[path].ends() is not None


def _draw(ax: Any, run: RunSignals, name: str, path: str) -> None:
    if not _has_points(run, f"{name}/{path}"):
        return
    asked = path not in READ_SERIES
    times, values = run.line(name, path)
    plot, _, word = path.partition("/")
    of = f"{name}: " if len(run.axes) > 1 else ""
    ax.plot(
        times / NS_PER_S,
        values,
        color=_GREY if asked else _color(run, name),
        linewidth=0.9 if asked else 0.8,
        drawstyle="steps-post" if asked else "default",
        label=None if asked and name != run.axes_in(plot)[0] else (word if asked else of + word),
    )


def _color(run: RunSignals, name: str) -> str:
    return _COLORS[run.axes.index(name) % len(_COLORS)]


def _mark_dropouts(ax: Any, run: RunSignals) -> None:
    """Mark when no reading came, of which axis ever, at the foot of a plot."""
    label = "dropout"
    for name in run.axes:
        begins, lasted = run.gaps[name].points(run.last_cycle + run.period_ns)
        if begins.size:
            spans = np.column_stack((begins, lasted)) / NS_PER_S
            ax.broken_barh(
                spans,
                (0.0, _RUG),
                transform=ax.get_xaxis_transform(),
                color=_RED,
                linewidth=_RUG_WIDTH,
                label=label,
            )
            label = "_"


def _draw_deadline(ax: Any, run: RunSignals) -> None:
    ax.axhline(run.deadline_ns / NS_PER_US, color=_RED, linewidth=0.8, linestyle="--", label="deadline")
    ax.set_ylim(bottom=0)


def _draw_judged(ax: Any, run: RunSignals, plot: str) -> None:
    """Draw the limits of an error where they hold, and shade where it is not counted."""
    reach = largest = max(run.shown_error(plot).values(), default=0.0)
    labels = {"limit": "limit" if len(run.axes) == 1 else "limits", "settling": "not counted"}
    for name in run.axes_in(plot):
        times, sizes = run.limit(name, plot)
        if times.size and (run.window_s == (None, None) or in_view(float(np.nanmin(sizes)), largest)):
            reach = max(reach, float(np.nanmax(sizes)))
        for signed in (sizes, -sizes) if times.size else ():
            ax.plot(
                times / NS_PER_S,
                signed,
                color=_RED if len(run.axes) == 1 else _color(run, name),
                linewidth=0.8,
                linestyle="--",
                label=labels.pop("limit", "_"),
            )
        if settling := run.settling(name, plot):
            ax.broken_barh(
                [(begin / NS_PER_S, (end - begin) / NS_PER_S) for begin, end in settling],
                (0.0, 1.0),
                transform=ax.get_xaxis_transform(),
                color=_SHADE,
                zorder=0,
                label=labels.pop("settling", "_"),
            )
    if reach:
        ax.set_ylim(-1.4 * reach, 1.4 * reach)


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
