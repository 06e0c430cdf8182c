"""``python -m tests.twin --count 40``: hidden drives, drawn, recorded and fitted.

Prints for each key how often its k = 2 holds the truth, the root mean square of the error over its standard
uncertainty, and the median width; then how well held-out runs were predicted, and the processor's time of a
fit. ``--bootstrap N`` as for ``hil fit``; ``--seconds``: length of a recording; ``--witness``: its motion is
integrated by solve_ivp, and nothing is held out. Leaves with 1 if a key holds
in less than 85 % or a run was not fitted.
"""

import argparse
import collections
import os
import statistics
import sys

from servobench import run
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.motor_file import MotorFile
from servobench.hil.twin.fitting import fit_recordings
from tests.twin.drawn import hidden_drive
from tests.twin.witness import integrated


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(prog="python -m tests.twin")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1000, help="of the first drive")
    parser.add_argument("--bootstrap", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--witness", action="store_true")
    given = parser.parse_args()
    scores: dict[str, list[float]] = collections.defaultdict(list)
    widths: dict[str, list[float]] = collections.defaultdict(list)
    ratios, seconds, failed = [], [], 0
    for seed in range(given.seed, given.seed + given.count):
        hidden = hidden_drive(seed, given.seconds)
        name = "reference.axis1.speed_rpm"
        recorded = (
            integrated(hidden) if given.witness else run(hidden.bench, signals={name: hidden.speed_rpm})
        )
        other = (
            None
            if given.witness
            else run(hidden.bench, {"bench.duration_s": 3.0}, signals={name: hidden.held_out_rpm})
        )
        start = MotorFile.model_validate(hidden.start)
        begin_s = os.times().user
        try:
            found = fit_recordings([recorded], start=start, hold_out=other, bootstrap=given.bootstrap)
        except BadInput as error:
            failed += 1
            print(f"{seed}: {error}", flush=True)
            continue
        seconds.append(os.times().user - begin_s)
        told = []
        for key in found.keys:
            if key.name in hidden.truth and key.uncertainty:
                score = 2.0 * (key.value - hidden.truth[key.name]) / key.uncertainty
                scores[key.name].append(score)
                widths[key.name].append(100.0 * key.uncertainty / abs(key.value) if key.value else 0.0)
                told.append(f"{score:6.2f}")
            elif key.name in hidden.truth:
                told.append(key.source)
        ratios.append(found.held_out_ratio or 0.0)
        windows = f"{len(found.windows)} windows"
        print(
            f"{seed}: {windows}, {' '.join(told)}, held out {ratios[-1]:.2f}, {seconds[-1]:.1f} s", flush=True
        )
    least = 1.0
    for name, values in scores.items():
        share = sum(abs(value) <= 2.0 for value in values) / len(values)
        rms = statistics.fmean(value * value for value in values) ** 0.5
        least = min(least, share)
        held = f"k=2 holds {100.0 * share:5.1f} %  rms {rms:5.2f} sigma"
        print(f"{name:32s} {len(values):4d} {held}  width {statistics.median(widths[name]):.3g} %")
    print(f"held out: median {statistics.median(ratios):.3f}, largest {max(ratios):.3f}; {failed} not fitted")
    times = f"median {statistics.median(seconds):.1f} s, longest {max(seconds):.1f} s"
    print(f"a fit of {given.seconds:g} s: {times}")
    return int(failed > 0 or least < 0.85)


if __name__ == "__main__":
    sys.exit(main())
