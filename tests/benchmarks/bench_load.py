"""What a load from a file costs of a bench's pace: ten points, and a million of them, beside no load.

Runs with and without the file take turns in one process, so that what slows this machine down meets both. A
run's pace is that of the quarter of its stretches of 50 ms that was disturbed least. Of each pair the ratio,
then the median and the quarters; the first row holds nothing against nothing and shows what the others are
worth. Reading the file is not counted. ``--pairs N``: how many of each case.
"""

import sys
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from servobench import Bench, run
from servobench.drivers.timebase import NS_PER_S, MonotonicClock

ROOT = Path(__file__).parents[2]
DURATION_S = 10.0
FIRST_S = 1.0
"""Loop time that is not counted: what is found or made once."""
CASES = {
    "none": (0, 0.0),
    "10 points over 10 s": (10, 10.0),
    "10^6 points over 1000 s": (1_000_000, 1000.0),
    "10^6 points over 10 s": (1_000_000, 10.0),
}


def main() -> None:
    """Print a table."""
    pairs = int(sys.argv[sys.argv.index("--pairs") + 1]) if "--pairs" in sys.argv else 11
    example = Bench.load(ROOT / "examples" / "ling2012.toml")
    bare = example.changed({"bench.duration_s": DURATION_S, "faults": None, "load": None, "verdict": None})
    with tempfile.TemporaryDirectory() as scratch:
        print(f"{'load from a file, pace x that without':40} {'p50':>8} {'p25':>8} {'p75':>8}   pairs")
        for title, (points, over_s) in CASES.items():
            loaded = bare
            if points:
                path = load_file(Path(scratch, f"{points}-{over_s:g}.parquet"), points, over_s)
                loaded = bare.changed({"load": {"axis1": [{"at_s": 0.0, "kind": "file", "path": str(path)}]}})
            ratios = [in_turn(bare, loaded, first=number % 2) for number in range(pairs + 1)]
            middle, low, high = np.percentile(ratios[1:], [50, 25, 75])
            print(f"{title:40} {middle:8.3f} {low:8.3f} {high:8.3f}   {pairs}", flush=True)


def load_file(path: Path, points: int, over_s: float) -> Path:
    """A load of +-0.2 N m, once up and down in 5 s."""
    import pyarrow as pa
    from pyarrow import parquet

    times_s = np.arange(points) * (over_s / points)
    torques_nm = 0.2 * np.sin(2.0 * np.pi * times_s / 5.0)
    parquet.write_table(pa.table({"time_s": times_s, "torque_nm": torques_nm}), path)
    return path


def in_turn(bare: Bench, loaded: Bench, first: int) -> float:
    """Pace with the load over that without; ``first``: 1 if the loaded one runs first."""
    paces = [pace(bench) for bench in ((bare, loaded), (loaded, bare))[first]]
    return paces[1 - first] / paces[first]


def pace(bench: Bench) -> float:
    """Simulated seconds per second."""
    watch = Watch()
    run(bench, progress=watch)
    stretches = np.diff(watch.seen, axis=0)
    return 1.0 / float(np.quantile(stretches[:, 1] / stretches[:, 0], 0.25))


class Watch:
    """Is told how far a run is, and notes when."""

    def __init__(self) -> None:
        self._clock = MonotonicClock()
        self.seen: Final[list[tuple[float, float]]] = []
        """Loop time and that of the clock, s."""

    def __call__(self, phase: str, elapsed_s: float) -> None:
        if elapsed_s >= FIRST_S and phase == "running":
            self.seen.append((elapsed_s, self._clock.now() / NS_PER_S))


if __name__ == "__main__":
    main()
