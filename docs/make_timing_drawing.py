"""Draw what is measured in a cycle: ``python docs/make_timing_drawing.py [DRAWING]``.

A cycle of 1000 us with the times of a quiet bus of 1 Mbit/s, but for the lateness of the host and the wait of
the command, which are drawn larger than they are.
"""

import argparse
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_HOST, _BUS, _DRIVE = 2.0, 1.0, 0.0
_INNER_US = 62.5
"""Inner loop of the drive at 16 kHz."""
_DUE, _WOKE, _HANDED, _SYNC_END = 0.0, 40.0, 60.0, 110.0
_READING = (150.0, 280.0)
_DECIDED = 370.0
_COMMAND = (430.0, 520.0)
_NEXT_SYNC = (1060.0, 1110.0)
_LABEL_US = 400.0
"""A span so wide has room for its text above it."""
_INK, _FRAME, _MEASURED = "#303540", "#9fc5e8", "#b3401f"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("drawing", type=Path, nargs="?", default=Path(__file__).parent / "timing.svg")
    drawing: Path = parser.parse_args().drawing
    # A fixed salt and no date: the same drawing is the same file.
    with mpl.rc_context({"svg.hashsalt": "timing", "svg.fonttype": "none", "font.size": 9}):
        draw().savefig(drawing, metadata={"Date": None} if drawing.suffix == ".svg" else None, dpi=110)
    print(drawing)


def draw() -> Figure:
    """The whole drawing."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlim(-110, 1190)
    axes.set_ylim(-1.6, 2.95)
    axes.axis("off")
    for height, name in ((_HOST, "host"), (_BUS, "bus"), (_DRIVE, "drive")):
        axes.plot([-40, 1180], [height, height], color=_INK, linewidth=0.8)
        axes.text(-105, height, name, va="center", fontweight="bold", color=_INK)
    _draw_bus(axes)
    _draw_host(axes)
    _draw_drive(axes)
    _draw_spans(axes)
    return figure


def _draw_bus(axes: Axes) -> None:
    frames = (
        (_HANDED, _SYNC_END, "SYNC"),
        (*_READING, "TPDO1"),
        (*_COMMAND, "RPDO1"),
        (*_NEXT_SYNC, "SYNC"),
    )
    for begin, end, name in frames:
        axes.fill_between([begin, end], _BUS - 0.14, _BUS + 0.14, color=_FRAME, edgecolor=_INK, linewidth=0.8)
        axes.text((begin + end) / 2, _BUS + 0.2, name, ha="center", color=_INK)
    for end in (_SYNC_END, _COMMAND[1]):
        _arrow(axes, end, _BUS + 0.14, end + 25, _HOST - 0.03, dashed=True)
        axes.text(end + 20, (_BUS + _HOST) / 2, "echo", color=_INK, style="italic")


def _draw_host(axes: Axes) -> None:
    for at, name, rise in ((_DUE, "due", 0.62), (_WOKE, "woke", 0.4), (_HANDED, "SYNC handed over", 0.16)):
        axes.plot([at, at], [_HOST, _HOST + rise], color=_INK, linewidth=0.8)
        axes.text(at + 4, _HOST + rise - 0.02, name, color=_INK, va="center")
    axes.text(_READING[1] + 4, _HOST + 0.14, "received", color=_INK, va="center")
    axes.text(_DECIDED + 4, _HOST + 0.38, "decided, command handed over", color=_INK, va="center")
    axes.plot([_DECIDED, _DECIDED], [_HOST, _HOST + 0.38], color=_INK, linewidth=0.8)
    _arrow(axes, _HANDED, _HOST, _HANDED, _BUS + 0.14)
    _arrow(axes, _READING[1], _BUS + 0.14, _READING[1], _HOST)
    _arrow(axes, _DECIDED, _HOST, _COMMAND[0], _BUS + 0.14)


def _draw_drive(axes: Axes) -> None:
    ticks = [15.0 + _INNER_US * number for number in range(19)]
    axes.plot(ticks, [_DRIVE] * len(ticks), "|", color=_INK, markersize=7)
    axes.text(760, _DRIVE + 0.12, "inner ticks, 62.5 us apart", ha="center", color=_INK)
    for at in (_SYNC_END, _NEXT_SYNC[1]):
        axes.plot(at, _DRIVE, "o", color=_MEASURED, markersize=6)
        _arrow(axes, at, _BUS - 0.14, at, _DRIVE + 0.06)
    axes.text(_SYNC_END + 12, _DRIVE + 0.3, "sampled: 1013h", color=_MEASURED)
    axes.text(_NEXT_SYNC[1] - 12, _DRIVE + 0.3, "sampled, 6074h", color=_MEASURED, ha="right")
    _arrow(axes, _COMMAND[1], _BUS - 0.14, _COMMAND[1], _DRIVE + 0.06)
    axes.text(_COMMAND[1] + 8, _DRIVE + 0.3, "acts on arrival", color=_INK)


def _draw_spans(axes: Axes) -> None:
    last_tick = 15.0 + _INNER_US
    spans = (
        (_DUE, _WOKE, _HOST + 0.8, "lateness"),
        (last_tick, _SYNC_END, -0.32, "the values: up to one inner tick older"),
        (_SYNC_END, _READING[1], -0.58, "delay of the reading"),
        (_DECIDED, _COMMAND[1], -0.84, "command, handed over to on the bus"),
        (_COMMAND[1], _NEXT_SYNC[1], -1.18, "it begins to act in here; exactly when, by an event"),
        (_SYNC_END, _NEXT_SYNC[1], -1.48, "from the sample to the actuation that rests on it, at the most"),
    )
    ends = {"arrowstyle": "|-|,widthA=0.2,widthB=0.2", "color": _MEASURED}
    for begin, end, height, text in spans:
        axes.annotate("", (begin, height), (end, height), arrowprops=ends)
        if end - begin > _LABEL_US:
            axes.text((begin + end) / 2, height + 0.05, text, color=_INK, ha="center")
        else:
            axes.text(end + 8, height, text, color=_INK, va="center")


def _arrow(axes: Axes, x: float, y: float, to_x: float, to_y: float, dashed: bool = False) -> None:
    style = {"arrowstyle": "->", "color": _INK, "linewidth": 0.8, "linestyle": "--" if dashed else "-"}
    axes.annotate("", (to_x, to_y), (x, y), arrowprops=style)


if __name__ == "__main__":
    main()
