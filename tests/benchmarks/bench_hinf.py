"""H-infinity synthesis beside SLICOT's in the same run: ``python -m tests.benchmarks.bench_hinf``."""

import timeit
from collections.abc import Callable

import numpy as np

from design.current.current_design import rule_weights
from design.hinf.mixed_sensitivity import axis_plant, mixed_sensitivity
from design.hinf.synthesis import gamma_min, synthesise
from design.papers.azaiz2007 import MOTOR

RUNS = 30
PLANT = mixed_sensitivity(axis_plant(0.6, 2.8e-3), rule_weights(MOTOR, "q"))


def report(name: str, work: Callable[[], object]) -> float:
    """Print p50, p99 and max of ``work`` in ms; returns p50."""
    work()
    times = 1e3 * np.array(timeit.repeat(work, number=1, repeat=RUNS))
    p50, p99 = np.percentile(times, [50, 99])
    print(f"{name:<28} p50 {p50:8.3f} ms   p99 {p99:8.3f} ms   max {times.max():8.3f} ms")
    return float(p50)


def main() -> None:
    """The q axis of [Azaiz2007]."""
    report("synthesis", lambda: synthesise(PLANT, 1.0))
    ours = report("gamma_min to 1e-10", lambda: gamma_min(PLANT))
    try:
        import slycot
    except ImportError:
        print("slycot is not installed: no comparison")
        return
    s = PLANT.system
    theirs = report(
        "SLICOT SB10AD, gamma to 1e-9",
        lambda: slycot.sb10ad(s.order, 2, 4, 1, 1, 10.0, s.A, s.B, s.C, s.D, 1, 1e-9, 0.0),
    )
    print(f"gamma_min: {ours / theirs:.1f} x SLICOT's compiled bisection")


if __name__ == "__main__":
    main()
