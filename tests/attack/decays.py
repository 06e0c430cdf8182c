"""Certified over found decays of the drawn loops: ``python -m tests.attack.decays --first 0 --loops 20``."""

import argparse

import numpy as np

from servobench.design.errors import NoSolution
from servobench.hil.studies.speed.loss_peaks import decay_of
from tests.attack.drawn import drawn_loop


def main() -> None:
    """Print a line for each loop, and what they have in common."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--loops", type=int, default=20, help="seeds tried")
    parser.add_argument("--first", type=int, default=0, help="seed to begin with")
    asked = parser.parse_args()
    ratios, refused = [], 0
    for seed in range(asked.first, asked.first + asked.loops):
        drawn = drawn_loop(seed)
        if drawn is None:
            continue
        name = f"{seed:5} {drawn.told['kind']:9} {drawn.readings} readings, {drawn.commands} commands"
        try:
            bound = decay_of(drawn.controller, drawn.readings, drawn.commands, drawn.inertias, drawn.delays)
        except NoSolution as error:
            refused += 1
            print(f"{name}  {error.status}", flush=True)
            continue
        ratios.append(bound.certified / bound.found)
        print(f"{name}  {bound.certified:9.4f} of {bound.found:9.4f} 1/s  {ratios[-1]:.3f}", flush=True)
    least, median = (np.min(ratios), np.median(ratios)) if ratios else (np.nan, np.nan)
    print(f"{len(ratios)} certified, {refused} not; over found: median {median:.3f}, least {least:.3f}")


if __name__ == "__main__":
    main()
