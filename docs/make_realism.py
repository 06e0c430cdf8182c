"""Draw what each effect of docs/realism.md does to one controller: ``python docs/make_realism.py [FOLDER]``.

The bench is the demo's, examples/ling2012.toml, with its PID, where no other is named; a picture has the
speed, or the error of the position, without the effect and with it, each with the verdict of its run.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from servobench import Run, run

ROOT: Final = Path(__file__).parents[1]
_RPM_PER_RAD_S: Final = 9.549296585513721
_INK, _IDEAL, _REAL = "#303540", "#9fc5e8", "#b3401f"
_SLOW: Final = {
    "load.axis1": [],
    "verdict.after_load_percent_max": None,
    "verdict.settling_ms": 400,
    "verdict.speed_error_peak_percent_max": 10.0,
    "verdict.torque_rms_nm_max": None,
    "reference.axis1": [{"at_s": 0.2, "kind": "step", "speed_rpm": 60.0}],
}
_TURNING: Final = {
    **_SLOW,
    "reference.axis1": [{"at_s": 0.2, "kind": "sine", "amplitude_rpm": 60.0, "frequency_hz": 1.0}],
}


class Case(NamedTuple):
    """One effect: its keys of ``drive.axis1``; ``bench``: keys of both runs, ``faults``: of that with it."""

    effect: Mapping[str, Any]
    bench: Mapping[str, Any] = {}
    from_s: float = 0.15
    to_s: float = 0.6
    faults: Mapping[str, Any] | None = None
    example: str = "ling2012"
    of_position: bool = False


CASES: Final[Mapping[str, Case]] = {
    "coupling": Case({"motor.coupling": {"inertia_ratio": 4.0, "antiresonance_hz": 150.0}}),
    "backlash": Case({"motor.coupling": {"antiresonance_hz": 300.0, "backlash_rad": 0.007}}, to_s=1.2),
    "friction": Case(
        {"motor.mechanics.coulomb_friction_nm": 0.1, "motor.friction": {"breakaway_nm": 0.4}},
        _TURNING,
        to_s=1.6,
    ),
    "cogging": Case({"motor.cogging": [{"per_turn": 24, "torque_nm": 0.04}]}, _SLOW, to_s=1.2),
    "encoder": Case({"simulation.encoder_counts_per_revolution": 4096}, from_s=0.5, to_s=1.2),
    "arm": Case({"motor.load": {"arm": {"torque_nm": 0.5}}}, from_s=0.4, to_s=1.2),
    "timing": Case(
        {"simulation.like": {"timing": {"rpdo_task_us": 400.0}}},
        from_s=0.52,
        to_s=0.74,
        example="position_csp",
        of_position=True,
    ),
    "current-sensor": Case(
        {"simulation.like": {"current_sensor": {"range_a": 20.0, "bits": 12, "offset_a_percent": 2.0}}},
        from_s=0.6,
        to_s=1.4,
        example="cabinet",
    ),
    "brake": Case(
        {},
        {"faults": {}},
        from_s=0.5,
        to_s=1.4,
        faults={"dragging_brake": [{"at_s": 0.6, "duration_s": 3.0, "torque_nm": 0.5}]},
    ),
    "dirt": Case(
        {},
        {"faults": {}},
        from_s=0.5,
        to_s=0.9,
        faults={"dirty_encoder": [{"at_s": 0.6, "duration_s": 0.1, "from_deg": 10.0, "to_deg": 11.0}]},
    ),
}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parent)
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="these effects")
    asked = parser.parse_args()
    folder: Path = asked.folder
    for name, case in ((name, CASES[name]) for name in asked.only):
        path = folder / f"realism-{name}.svg"
        # A fixed salt and no date: the same drawing is the same file.
        with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "none", "font.size": 9}):
            draw(case).savefig(path, metadata={"Date": None})
        print(path)


def runs_of(case: Case) -> tuple[Run, Run]:
    """Without the effect and with it."""
    bench = ROOT / "examples" / f"{case.example}.toml"
    effect = {f"drive.axis1.{key}": value for key, value in case.effect.items()}
    if case.faults is not None:
        effect["faults"] = case.faults
    return run(bench, case.bench), run(bench, {**case.bench, **effect})


def draw(case: Case) -> Figure:
    """Both speeds over the time."""
    figure = Figure(figsize=(9, 3), layout="constrained")
    axes = figure.add_subplot()
    for title, colour, found in zip(("ideal", "with it"), (_IDEAL, _REAL), runs_of(case), strict=True):
        _plot(axes, found, case.of_position, f"{title}: {found.verdict.outcome}", colour)
    what = "error of the position, mrad" if case.of_position else "speed, r/min"
    axes.set(xlabel="time, s", ylabel=what, xlim=(case.from_s, case.to_s))
    within = np.concatenate([np.asarray(line.get_ydata())[_shown(line, case)] for line in axes.lines])
    room = 0.06 * (np.nanmax(within) - np.nanmin(within))
    axes.set_ylim(np.nanmin(within) - room, np.nanmax(within) + room)
    axes.legend(frameon=False, loc="best")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure


def _shown(line: Line2D, case: Case) -> NDArray[np.bool_]:
    time_s = np.asarray(line.get_xdata())
    return (case.from_s <= time_s) & (time_s <= case.to_s)


def _plot(axes: Axes, found: Run, of_position: bool, label: str, colour: str) -> None:
    shown = found.column("velocity_rad_s") * _RPM_PER_RAD_S
    if of_position:
        shown = 1e3 * (found.column("reference_position_rad") - found.column("position_rad"))
    axes.plot(np.arange(len(shown)) * 1e-3, shown, color=colour, linewidth=1.0, label=label)


if __name__ == "__main__":
    main()
