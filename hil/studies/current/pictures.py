"""Pictures of current loops and of [Azaiz2007]'s drive."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from servobench.design.current.current_design import AxisDesign, complementary, step_response
from servobench.design.hinf.mixed_sensitivity import loop_functions
from servobench.design.papers.azaiz2007 import DriveRun
from servobench.design.statespace import series
from servobench.hil.studies.drawing import draw_all, picture


def draw_bounds(design: AxisDesign, path: Path) -> None:
    """|S|, |KS| and |T| beside their bounds 1/|w|, in one picture."""
    with picture(path, 1, 3, size=(12.0, 4.0), sharex=True) as axes:
        for axis, name in zip(axes, design.weights.by_function, strict=True):
            _bound_on(axis, design, name)


def draw_bound(design: AxisDesign, name: str, path: Path) -> None:
    """One of |S|, |KS| and |T| beside its bound: Fig. 9, 10 or 11."""
    with picture(path) as axis:
        _bound_on(axis, design, name)


def _bound_on(axis: Any, design: AxisDesign, name: str) -> None:
    omega = np.logspace(-3, 7, 1500)
    gain = loop_functions(design.plant, design.controller, omega)[name]
    bound = 1.0 / np.abs(design.weights.by_function[name].system.response(omega)[:, 0, 0])
    axis.semilogx(omega, _db(bound), "--", label="bound 1/|w|")
    axis.semilogx(omega, _db(gain), label=f"|{name}|")
    axis.set(title=f"|{name}|", xlabel="rad/s", ylabel="dB")
    axis.set_ylim(bottom=max(-180.0, float(_db(gain).min()) - 5.0))
    axis.grid(alpha=0.3)
    axis.legend()


def draw_open_loop(design: AxisDesign, path: Path) -> None:
    """Bode diagram of L = G K: Fig. 7."""
    omega = np.logspace(-2, 5, 1500)
    loop = series(design.plant, design.controller).response(omega)[:, 0, 0]
    phase_deg, gain_db = design.margins.phase_margin_deg, design.margins.gain_margin_db
    with picture(path, 2, sharex=True) as (gain, phase):
        gain.semilogx(omega, _db(np.abs(loop)))
        gain.axhline(0.0, color="grey", linewidth=0.8)
        gain.set(
            ylabel="|L|, dB",
            title=f"gain margin {gain_db:.2f} dB, phase margin {phase_deg:.2f} degrees",
        )
        phase.semilogx(omega, np.degrees(np.unwrap(np.angle(loop))))
        phase.set(ylabel="degrees", xlabel="rad/s")


def draw_step(design: AxisDesign, path: Path) -> None:
    """Answer of the current to a unit step of its reference: Fig. 8."""
    time_s = np.linspace(0.0, 3.0 * design.step.settling_time_s, 800)
    with picture(path) as axis:
        axis.plot(1e3 * time_s, step_response(complementary(design.plant, design.controller), time_s))
        axis.set(
            xlabel="ms",
            ylabel="A",
            title=f"rise {1e3 * design.step.rise_time_s:.2f} ms, "
            f"settling {1e3 * design.step.settling_time_s:.2f} ms",
        )


def draw_runs(runs: Mapping[str, DriveRun], path: Path) -> None:
    """Torque, currents and speed of the drive: Figs. 12 and 13."""
    with picture(path, 2, 2, size=(10.0, 6.5), sharex=True) as axes:
        for name, run in runs.items():
            shown = (run.torque_nm, run.current_q_a, run.current_d_a, run.speed_rad_s)
            for axis, values in zip(axes.flat, shown, strict=True):
                axis.plot(1e3 * run.time_s, values, label=name.replace("_", " "), linewidth=1.0)
        for axis, label in zip(axes.flat, ("torque, N m", "i_q, A", "i_d, A", "speed, rad/s"), strict=True):
            axis.set_ylabel(label)
        for axis in axes[1]:
            axis.set_xlabel("ms")
        axes[0, 0].legend(fontsize=8)


def draw_paper(
    designs: Mapping[str, tuple[AxisDesign, AxisDesign]], runs: Mapping[str, DriveRun], folder: Path
) -> list[Path]:
    """Every figure of the paper into ``folder``; returns the files."""
    q = designs["q"][0]
    files: dict[str, Callable[[Path], None]] = {
        "fig07-open-loop-q.png": lambda path: draw_open_loop(q, path),
        "fig08-step-q.png": lambda path: draw_step(q, path),
        "fig09-sensitivity-q.png": lambda path: draw_bound(q, "S", path),
        "fig10-control-q.png": lambda path: draw_bound(q, "KS", path),
        "fig11-complementary-q.png": lambda path: draw_bound(q, "T", path),
        "fig12-nominal.png": lambda path: draw_runs({"nominal": runs["nominal"]}, path),
        "fig13-varied.png": lambda path: draw_runs(runs, path),
        "open-loop-d.png": lambda path: draw_open_loop(designs["d"][0], path),
        "step-d.png": lambda path: draw_step(designs["d"][0], path),
        "bounds-d.png": lambda path: draw_bounds(designs["d"][0], path),
    }
    return draw_all(folder, files)


def _db(values: Any) -> Any:
    return 20.0 * np.log10(np.maximum(values, 1e-20))
