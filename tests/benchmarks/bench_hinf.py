"""H-infinity synthesis beside SLICOT's in the same run: ``python -m tests.benchmarks.bench_hinf``."""

import timeit
from collections.abc import Callable

import numpy as np

from servobench.design.current.current_design import rule_weights
from servobench.design.hinf.mixed_sensitivity import axis_plant, mixed_sensitivity
from servobench.design.hinf.synthesis import gamma_min, synthesise
from servobench.design.papers.azaiz2007 import MOTOR

RUNS = 100
PLANT = mixed_sensitivity(axis_plant(0.6, 2.8e-3), rule_weights(MOTOR, "q"))


def report(works: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Print p50, p99 and max of each work in ms, run in turn; returns the least time of each."""
    rounds = [[timeit.timeit(work, number=1) for work in works.values()] for _ in range(RUNS + 1)]
    least = {}
    for name, times in zip(works, 1e3 * np.array(rounds[1:]).T, strict=True):
        p50, p99 = np.percentile(times, [50, 99])
        print(f"{name:<28} p50 {p50:8.3f} ms   p99 {p99:8.3f} ms   max {times.max():8.3f} ms")
        least[name] = float(times.min())
    return least


def main() -> None:
    """The q axis of [Azaiz2007]. SB10FD does not look for what breaks the assumptions, ours does."""
    works: dict[str, Callable[[], object]] = {
        "synthesis": lambda: synthesise(PLANT, 1.0),
        "gamma_min to 1e-10": lambda: gamma_min(PLANT),
    }
    try:
        import slycot
    except ImportError:
        report(works)
        print("slycot is not installed: no comparison")
        return
    s = PLANT.system
    works["SLICOT SB10FD, one gamma"] = lambda: slycot.sb10fd(s.order, 2, 4, 1, 1, 1.0, s.A, s.B, s.C, s.D)
    works["SLICOT SB10AD, gamma to 1e-9"] = lambda: slycot.sb10ad(
        s.order, 2, 4, 1, 1, 10.0, s.A, s.B, s.C, s.D, 1, 1e-9, 0.0
    )
    one, search, their_one, their_search = report(works).values()
    print(f"least: synthesis {one / their_one:.1f} x SB10FD, gamma_min {search / their_search:.1f} x SB10AD")


if __name__ == "__main__":
    main()
