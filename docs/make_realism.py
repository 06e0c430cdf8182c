"""Draw what each effect of docs/realism.md does to one controller: ``python docs/make_realism.py [FOLDER]``.

The bench is the demo's, examples/ling2012.toml, with its PID; a picture has the speed on the ideal shaft and
on the one with the effect, each with the verdict of its run.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
    """One effect: its keys of ``drive.axis1``; ``bench``: keys of both runs."""

    effect: Mapping[str, Any]
    bench: Mapping[str, Any] = {}
    from_s: float = 0.15
    to_s: float = 0.6


CASES: Final[Mapping[str, Case]] = {
    "coupling": Case({"motor.coupling": {"inertia_ratio": 4.0, "antiresonance_hz": 150.0}}),
    "backlash": Case({"motor.coupling": {"antiresonance_hz": 300.0, "backlash_rad": 0.007}}, to_s=1.2),
    "friction": Case(
        {"motor.mechanics.coulomb_friction_nm": 0.1, "motor.friction": {"breakaway_nm": 0.4}},
        _TURNING,
        to_s=1.6,
    ),
    "cogging": Case({"motor.cogging": [{"per_turn": 24, "torque_nm": 0.04}]}, _SLOW, to_s=1.2),
    "encoder": Case({"simulation.encoder_counts_per_revolution": 4096}, to_s=1.2),
}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parent)
    folder: Path = parser.parse_args().folder
    for name, case in CASES.items():
        path = folder / f"realism-{name}.svg"
        # A fixed salt and no date: the same drawing is the same file.
        with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "none", "font.size": 9}):
            draw(case).savefig(path, metadata={"Date": None})
        print(path)


def runs_of(case: Case) -> tuple[Run, Run]:
    """Without the effect and with it."""
    bench = ROOT / "examples" / "ling2012.toml"
    effect = {f"drive.axis1.{key}": value for key, value in case.effect.items()}
    return run(bench, case.bench), run(bench, {**case.bench, **effect})


def draw(case: Case) -> Figure:
    """Both speeds over the time."""
    figure = Figure(figsize=(9, 3), layout="constrained")
    axes = figure.add_subplot()
    for title, colour, found in zip(("ideal", "with it"), (_IDEAL, _REAL), runs_of(case), strict=True):
        _plot(axes, found, f"{title}: {found.verdict.outcome}", colour)
    axes.set(xlabel="time, s", ylabel="speed, r/min", xlim=(case.from_s, case.to_s))
    axes.legend(frameon=False, loc="best")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure


def _plot(axes: Axes, found: Run, label: str, colour: str) -> None:
    speed = found.column("velocity_rad_s") * _RPM_PER_RAD_S
    axes.plot(np.arange(len(speed)) * 1e-3, speed, color=colour, linewidth=1.0, label=label)


if __name__ == "__main__":
    main()
