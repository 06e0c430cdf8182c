"""Plots the stages of a measurement as histograms."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from servobench.hil.measuring.figures import Measured
from servobench.hil.reviewing.network_meter import delays_of, histogram_of

_BLUE, _RED, _GRID = "#1f5fa8", "#c8442c", "#e3e6ea"
_ROW_INCHES = 1.3


def draw_stages(path: Path, measured: Measured) -> None:
    """Draw a row for each measured stage, of the host and of each drive; p50, p99 and p99.9 marked."""
    rows = [(each.title, each.times) for each in measured.host if each.measured]
    for drive in measured.drives:
        rows += [(f"node {drive.node}: {each.title}", each.times) for each in drive.stages if each.measured]
    figure = Figure(figsize=(8.0, _ROW_INCHES * len(rows) + 0.4), layout="constrained")
    for ax, (title, times) in zip(np.atleast_1d(figure.subplots(len(rows), 1)), rows, strict=True):
        bars, quantiles = histogram_of(times), delays_of(times)
        assert bars is not None
        assert quantiles is not None
        ax.stairs(np.array(bars.counts), np.array(bars.edges_us), fill=True, color=_BLUE)
        for value, style in ((quantiles.p50, "-"), (quantiles.p99, "--"), (quantiles.p999, ":")):
            ax.axvline(value, color=_RED, linewidth=1.0, linestyle=style)
        ax.set_yscale("log")
        ax.set_ylim(bottom=0.5)  # one of them has a height too
        ax.set_title(title, loc="left", fontsize="small")
        ax.grid(color=_GRID, linewidth=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    ax.set_xlabel("us; lines: p50, p99 (dashed), p99.9 (dotted)")
    figure.savefig(path, dpi=110)
