"""How near commissioning comes to what is hidden: drives drawn from seeds, in simulated time.

    python -m tests.benchmarks.bench_commissioning [--seeds 0-49] [--loss] [--drift-ppm 300] [--processes 2]
                                                   [--seconds 600]

One row a drive; the delays are compared with what was seen inside the simulated drive. ``missed`` and
``invented``: faults of polarity and units. At the end, of each figure with a stated uncertainty: how often it
held, and its width, root mean square over all drives, beside twice the root mean square of the errors. An
uncertainty of k = 2 that is earned holds for some 95 %, at a width of 1.
"""

import argparse
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.commissioning.findings import StepVerdict
from tests.commissioning import LOSS, Errors, errors_of, unknown_world

LIMITS = {"inertia": 0.03, "viscous": 0.08, "coulomb": 0.08}
UNIT_LIMIT = 0.005
DELAY_LIMIT_US = 20.0
HEAD = "seed   inertia  viscous  coulomb  position velocity  torque   reading    effect  missed  invented"


def measured(seed: int, lossy: bool, drift_ppm: float) -> tuple[int, Errors | None, list[str], float]:
    """Errors of one drive, steps that were not done, s of wall clock; no errors: it came to nothing."""
    clock = MonotonicClock()
    began = clock.now()
    with tempfile.TemporaryDirectory() as folder:
        truth, result, spy = unknown_world(
            seed, Path(folder), faults=LOSS if lossy else None, drift_ppm=drift_ppm, spied=True
        )
    failed = [
        f"{record.name}: {record.reason}"
        for record in result.records
        if record.verdict is not StepVerdict.DONE
    ]
    if result.left.restoration is None or not result.left.restoration.complete:
        failed.append("not put back")
    complete = result.findings.mechanics is not None and result.findings.effect_delay_us is not None
    errors = errors_of(truth, result, spy) if complete else None
    return seed, errors, failed, (clock.now() - began) / NS_PER_S


def row(seed: int, errors: Errors) -> str:
    """One line of the table."""
    percents = (errors.inertia, errors.viscous, errors.coulomb)
    units = (errors.position, errors.velocity, errors.rated_torque)
    return (
        f"{seed:4}  "
        + " ".join(f"{100.0 * value:+7.2f}%" for value in percents)
        + "  "
        + " ".join(f"{100.0 * value:+7.2f}%" for value in units)
        + f"  {errors.reading_delay_us:+6.1f} us {errors.effect_delay_us:+6.1f} us"
        + f"  {','.join(sorted(errors.missed)) or '-':6}  {','.join(sorted(errors.invented)) or '-'}"
    )


def within(errors: Errors) -> bool:
    """Inside every limit."""
    return (
        abs(errors.inertia) <= LIMITS["inertia"]
        and abs(errors.viscous) <= LIMITS["viscous"]
        and abs(errors.coulomb) <= LIMITS["coulomb"]
        and all(abs(e) <= UNIT_LIMIT for e in (errors.position, errors.velocity, errors.rated_torque))
        and abs(errors.reading_delay_us) <= DELAY_LIMIT_US
        and abs(errors.effect_delay_us) <= DELAY_LIMIT_US
        and not errors.missed
        and not errors.invented
    )


class Coverage(NamedTuple):
    """How well a stated uncertainty holds."""

    held_percent: float
    """Of the drives, in which the error was within what was stated."""
    width: float
    """Stated over twice the errors, each as root mean square."""
    bias_percent: float
    rms_percent: float


def coverage(found: Sequence[Errors], name: str) -> Coverage:
    """Of ``inertia``, ``viscous`` or ``coulomb``."""
    error = np.array([getattr(errors, name) for errors in found])
    stated = np.array([getattr(errors, f"{name}_stated") for errors in found])
    rms = float(np.sqrt(np.mean(error**2)))
    width = float(np.sqrt(np.mean(stated**2))) / (2.0 * rms)
    held = float(np.mean(np.abs(error) <= stated))
    return Coverage(100.0 * held, width, 100.0 * float(np.mean(error)), 100.0 * rms)


def print_coverage(found: Sequence[Errors]) -> None:
    """A line for each figure that has an uncertainty."""
    for name in LIMITS:
        held, width, bias, rms = coverage(found, name)
        print(
            f"{name:8} k = 2 holds for {held:5.1f} % of {len(found)}, width {width:.2f} of 2 rms, "
            f"bias {bias:+.4f} %, rms {rms:.4f} %"
        )


def main() -> None:
    """The table, and the worst of each column."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", default="0-49", help="first-last")
    parser.add_argument("--loss", action="store_true", help="1 %% of the PDOs lost, each way")
    parser.add_argument("--drift-ppm", type=float, default=0.0, help="of the drive's clock")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seconds", type=float, help="after which no further drive is begun")
    given = parser.parse_args()
    first, _, last = given.seeds.partition("-")
    seeds = range(int(first), int(last or first) + 1)
    print(HEAD, flush=True)
    found: list[Errors] = []
    outside = tried = 0
    clock = MonotonicClock()
    until = clock.now() + round((given.seconds or 1e9) * NS_PER_S)
    with ProcessPoolExecutor(given.processes) as pool:
        jobs = [pool.submit(measured, seed, given.loss, given.drift_ppm) for seed in seeds]
        for job in jobs:
            if clock.now() > until and job.cancel():
                continue
            tried += 1
            seed, errors, failed, took_s = job.result()
            if errors is None:
                outside += 1
                print(f"{seed:4}  came to nothing: {'; '.join(failed)}", flush=True)
                continue
            found.append(errors)
            good = within(errors) and not failed
            outside += not good
            mark = "" if good else f"  <-- {'; '.join(failed) or 'outside'}"
            print(f"{row(seed, errors)}  {took_s:4.1f} s{mark}", flush=True)
    if not found:
        raise SystemExit("every drive came to nothing")
    worst = {
        name: max(abs(getattr(errors, name)) for errors in found)
        for name in ("inertia", "viscous", "coulomb", "position", "velocity", "rated_torque")
    }
    print("worst " + ", ".join(f"{name} {100.0 * value:.2f} %" for name, value in worst.items()))
    delays = [max(abs(getattr(e, name)) for e in found) for name in ("reading_delay_us", "effect_delay_us")]
    print(f"worst delay: reading {delays[0]:.1f} us, effect {delays[1]:.1f} us")
    print_coverage(found)
    print(f"{tried - outside} of {tried} within every limit, {len(seeds) - tried} not tried")


if __name__ == "__main__":
    main()
