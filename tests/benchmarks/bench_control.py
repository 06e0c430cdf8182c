"""Speed peaks after a load step over the floor that no controller beats, on whole runs of a simulated drive.

    predictor, the same fused with the count of the speed's own SYNC, H-infinity, PI with a load-torque
    observer, PID (hil design pid), static gain with integral (hil design speed --integral)
    h + tau = 2, 4, 20 ms at 1 kHz; a step of 30 % of the rated torque at 8 or 4 instants of a period

Each figure is over its own floor: with its inertia, its losses, and tau up to the torque at the shaft (the
drive's dead time included; its speed filter and its current's rise count to the ratio). ``median`` and
``worst``: over the instants, each with the encoder's noise as it comes. A line ``(least)`` before those of a
motor: what no controller of the drive's speed with a torque noise of 5 % can beat in the mean, by estimation
theory (tests/noise_floor.py), over the same instants.
"""

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from servobench.design.errors import DesignError
from servobench.drivers.errors import BenchError
from servobench.hil.configuration.motor_file import LING2012, load_motor
from tests.floor_runs import (
    PERIOD_S,
    Case,
    fused,
    hinf,
    measure,
    observing,
    pid,
    predictor,
    request,
    static,
    table_of,
)
from tests.noise_floor import NoisyStep
from tests.random_motors import designed

_OTHERS: Final = {"fused": fused, "hinf": hinf, "observer": observing, "pid": pid, "static": static}
AZAIZ2007 = Path("examples/motors/azaiz2007.toml")


def cases() -> Iterator[tuple[Case, int]]:
    """Those of the table, each with how many instants of the step."""
    ling = LING2012.model_dump(mode="json")
    azaiz = load_motor(AZAIZ2007).model_dump(mode="json")
    randoms = [designed(np.random.default_rng(seed)).motor for seed in (1, 2, 3)]
    for delay_s in (1e-3, 3e-3, 19e-3):
        yield Case("ling2012", ling, delay_s), 8
    for counts, of in ((4096, "4096 counts"), (1 << 20, "20 bits")):
        for delay_s in (1e-3, 3e-3, 19e-3):
            yield Case(f"ling2012, {of}", ling, delay_s, counts), 8
    for name, motor in (("azaiz2007", azaiz), *((f"random {k + 1}", m) for k, m in enumerate(randoms))):
        for delay_s in (1e-3, 3e-3, 19e-3):
            yield Case(name, motor, delay_s), 4


def predictor_table(case: Case) -> dict[str, Any]:
    """[controller] of the predictor on the speed alone."""
    return table_of(predictor(case))


def least(case: Case, phases: int) -> tuple[float, float]:
    """Median and worst over the instants of the least mean peak over the floor."""
    asked = request(case)
    step = NoisyStep(
        asked.plant,
        asked.period_s,
        asked.delay_s,
        case.load_nm,
        asked.speed_noise_rad_s,
        asked.command_noise_nm,
    )
    ratios = [step.least_peak_rad_s(phase / phases) / case.floor_rad_s() for phase in range(phases)]
    return float(np.median(ratios)), max(ratios)


def main() -> None:
    """A line for each motor, delay and controller."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--only", default="", help="one motor, by its whole name")
    arguments.add_argument("--phases", type=int, default=0, help="of a period, in place of 8 and 4")
    arguments.add_argument("--controllers", default="", help="names with commas between; default: all")
    chosen = arguments.parse_args()
    columns = ("median", "worst", "J 70 %", "J 130 %", "5 lost", "noise/rated %", "steady rad/s")
    print(
        f"{'motor':22} {'h+tau':>6} {'controller':10} " + " ".join(f"{name:>13}" for name in columns),
        flush=True,
    )
    for case, phases in cases():
        if chosen.only not in ("", case.name):
            continue
        print(
            f"{case.name:22} {1e3 * (PERIOD_S + case.delay_s):6.0f} {'(least)':10} "
            + " ".join(f"{value:13.3f}" for value in least(case, chosen.phases or phases)),
            flush=True,
        )
        ways: dict[str, Callable[[Case], dict[str, Any]]] = {"predictor": predictor_table, **_OTHERS}
        for name in filter(None, chosen.controllers.split(",")) if chosen.controllers else ways:
            way = partial(ways[name], case)
            try:
                each = measure(case, way(), chosen.phases or phases)
            except (BenchError, DesignError) as error:  # a loop that is unstable ends its run
                print(f"{case.name:22} {1e3 * (PERIOD_S + case.delay_s):6.0f} {name:10} {error}", flush=True)
                continue
            noise = 100.0 * each.noise_nm / float(case.motor["rating"]["torque_nm"])
            figures = (each.median, each.worst, each.inertia_70, each.inertia_130, each.lost, noise)
            print(
                f"{case.name:22} {1e3 * (PERIOD_S + case.delay_s):6.0f} {name:10} "
                + " ".join(f"{value:13.3f}" for value in (*figures, each.steady_rad_s)),
                flush=True,
            )


if __name__ == "__main__":
    main()
