"""Pictures of speed loops with delay: [Ling2012] Table 2, Figs. 5 to 7, and the three strategies."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from servobench.design.delay.delay_response import DelayResponse
from servobench.design.papers.ling2012 import (
    DELAY_S,
    LOAD_ON_S,
    SPEED_RAD_S,
    load_pulse,
    start_up,
)
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.studies.drawing import draw_all, picture
from servobench.hil.studies.papers.reproduction import LOAD_AT_S, PaperRun

_LABELS = {
    "stamp": "stamp, 5 of 6 lost",
    "arrival": "arrival, 5 of 6 lost",
    "history": "stamp without loss: what history gives",
    "pi_careful": "PI crossing at 60 rad/s, 1 ms",
    "pi_eager": "PI crossing at 200 rad/s, 1 ms",
}
_METHODS = {
    "published_delay_s": ("printed", "k--x"),
    "ccl_delay_s": ("Algorithm 4.2 (CCL)", "C0-o"),
    "lmi_delay_s": ("best certificate of Theorem 3.3", "C1-"),
    "exact_speed_feedback_delay_s": ("exact, speed feedback only", "C2-"),
    "exact_delay_s": ("exact, full feedback", "C3-"),
}


def draw_table(table: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> None:
    """Table 2 by every method, in both conventions of units."""
    with picture(path, 1, 2, size=(11.0, 4.5)) as axes:
        titles = {"published": "gamma in r/min per N m, as printed", "si": "gamma in rad/s per N m"}
        for axis, (units, rows) in zip(axes, table.items(), strict=True):
            _plot_delays(axis, rows, SPEED_RAD_S / RAD_S_PER_RPM)
            axis.set_title(titles[units])
        axes[0].legend(fontsize=8)


def draw_motor(figures: Mapping[str, Any], path: Path) -> None:
    """Draw Table 2 for a user's motor."""
    with picture(path) as axis:
        _plot_delays(axis, [row for row in figures["rows"] if "impossible" not in row], figures["speed_rpm"])
        axis.set_title(f"{figures['motor']}: load step of {figures['load_nm']:.4g} N m")
        axis.legend(fontsize=8)


def _plot_delays(axis: Any, rows: Sequence[Mapping[str, Any]], speed_rpm: float) -> None:
    for key, (label, style) in _METHODS.items():
        if all(key in row for row in rows):
            delays = [np.nan if row[key] is None else 1e3 * row[key] for row in rows]
            axis.plot([row["error_percent"] for row in rows], delays, style, label=label, ms=4)
    axis.set(xlabel=f"speed error, % of {speed_rpm:.5g} r/min", ylabel="largest delay, ms", yscale="log")
    axis.grid(alpha=0.3, which="both")


def draw_start(runs: Sequence[PaperRun], path: Path) -> None:
    """Case 1: Fig. 5."""
    with picture(path) as axis:
        _plot_continuous(axis, start_up())
        _plot_errors(axis, [run for run in runs if run.case == "case1"], 0.0)
        axis.axvline(0.15, color="grey", linestyle=":", label="0.15 s, printed")
        axis.set(xlabel="s", ylabel="speed error, % of 1500 r/min", xlim=(0.0, 1.5))
        axis.legend(fontsize=8)


def draw_comparison(runs: Sequence[PaperRun], path: Path) -> None:
    """Case 2: Fig. 6."""
    shown = [run for run in runs if run.case == "case2" or (run.case == "case1" and run.variant == "stamp")]
    with picture(path) as axis:
        for run in shown:
            speed_rpm = (SPEED_RAD_S - run.error_rad_s) / RAD_S_PER_RPM
            label = _LABELS[run.variant] if run.case == "case2" else "robust controller, stamp, 5 of 6 lost"
            axis.plot(run.time_s, speed_rpm, label=label, linewidth=1.0)
        axis.set(xlabel="s", ylabel="speed, r/min", xlim=(0.0, 1.5))
        axis.legend(fontsize=8)


def draw_load(runs: Sequence[PaperRun], path: Path) -> None:
    """Case 3: Fig. 7."""
    with picture(path) as axis:
        _plot_continuous(axis, load_pulse())
        _plot_errors(axis, [run for run in runs if run.case == "case3"], LOAD_AT_S)
        axis.axhline(5.0, color="grey", linestyle=":", label="5 %, printed")
        axis.axvspan(0.0, LOAD_ON_S, alpha=0.1, color="C3", label="0.6 N m")
        axis.axvline(
            DELAY_S, color="C3", linestyle="--", linewidth=0.8, label="first reaction at a delay of 64 ms"
        )
        axis.set(
            xlabel="s after the load",
            ylabel="speed error, % of 1500 r/min",
            xlim=(-0.05, 0.8),
            ylim=(-15.0, 35.0),
        )
        axis.legend(fontsize=8)


def draw_strategies(analyses: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> None:
    """Decay and gain of the sampled loop with d lost of every d + 1, by strategy."""
    with picture(path, 1, 2, size=(11.0, 4.5)) as axes:
        most = max(len(rows) for rows in analyses.values())
        for name, rows in analyses.items():
            # with history losses make no difference
            shown = list(rows) if len(rows) == most else list(rows) * most
            for axis, key in zip(axes, ("decay_per_s", "gamma"), strict=True):
                axis.plot([np.nan if row[key] is None else row[key] for row in shown], "-o", ms=4, label=name)
        for axis, label in zip(axes, ("decay, 1/s", "gain, rad/s per N m"), strict=True):
            axis.set(xlabel="d: lost of every d + 1", ylabel=label, ylim=(0.0, None))
        axes[0].legend()


def draw_ling2012(
    figures: Mapping[str, Any],
    runs: Sequence[PaperRun],
    folder: Path,
) -> list[Path]:
    """Every picture into ``folder``; returns the files."""
    strategies = {name: item["by_losses"] for name, item in figures["strategies"].items()}
    files: dict[str, Callable[[Path], None]] = {
        "table2.png": lambda path: draw_table(figures["table2"], path),
        "fig05-start.png": lambda path: draw_start(runs, path),
        "fig06-pid.png": lambda path: draw_comparison(runs, path),
        "fig07-load.png": lambda path: draw_load(runs, path),
        "strategies.png": lambda path: draw_strategies(strategies, path),
    }
    return draw_all(folder, files)


def _plot_continuous(axis: Any, response: DelayResponse) -> None:
    error_percent = 100.0 * response.x[:, 1] / SPEED_RAD_S
    axis.plot(response.time_s, error_percent, "k", label="continuous, constant delay of 64 ms")


def _plot_errors(axis: Any, runs: Sequence[PaperRun], from_s: float) -> None:
    for run in runs:
        label = f"bench: {_LABELS[run.variant]}"
        axis.plot(run.time_s - from_s, 100.0 * run.error_rad_s / SPEED_RAD_S, label=label, linewidth=1.0)
