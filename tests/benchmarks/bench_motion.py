"""How closely a shaft follows a motion: positions through torques beside a drive's own loops, mrad.

The motions are those of tests/scenario/test_position_tracking.py, each drawn anew from a seed; the errors are
of 6064h at its SYNC, from the frames on the bus, rms away from jumps of the speed.
"""

import tempfile
from pathlib import Path
from statistics import median

import numpy as np

from servobench import run
from servobench.hil.testing.run import Run
from tests.scenario.processes import EXAMPLES
from tests.scenario.test_position_tracking import CSP, CST, Motion, calm, changes, drawn_motion, errors

CSV = EXAMPLES / "position_csv.toml"
RUNS = 5
ARRIVED_S = 0.6
WAYS = {
    "fused, cst": (CST, "fused"),
    "predictor, cst": (CST, "predictor"),
    "the drive's own position loop, csp": (CSP, ""),
    "the bench's position loop, csv": (CSV, ""),
}


def main() -> None:
    """Print a line for each way."""
    kinds = {"S-curve": ["s_curve"], "sine": ["sine"], "all": ["s_curve", "ramp", "sine"]}
    print(f"{'rms error, mrad: median, worst of ' + str(RUNS):38}" + "".join(f"{kind:>18}" for kind in kinds))
    for name, (bench, controller) in WAYS.items():
        cells = []
        for kind in kinds.values():
            found = [_rms_mrad(bench, controller, drawn_motion(seed, kind)) for seed in range(RUNS)]
            cells.append(f"{median(found):10.3f}{max(found):8.3f}")
        print(f"{name:38}" + "".join(cells), flush=True)


def _rms_mrad(bench: Path, controller: str, motion: Motion) -> float:
    with tempfile.TemporaryDirectory() as folder:
        done: Run = run(bench, changes(bench, motion, controller), record=Path(folder) / "run")
        at, error = errors(done, motion, ARRIVED_S, 2.0)
    return float(1e3 * np.sqrt(np.mean(error[calm(at, motion)] ** 2)))


if __name__ == "__main__":
    main()
