"""``python -m tests.mutants``: so many mutated files through their loaders, each kind in turn."""

import argparse
import tempfile
from itertools import count
from pathlib import Path
from typing import Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.mutants.kinds import KINDS
from tests.mutants.mutant import failures
from tests.mutants.recordings import recording_kinds
from tests.mutants.seals import seal_breaker

LOADERS_EACH: Final = 8
"""Mutants of every other file for one of each file of a recording, which takes fifty times as long."""


def main() -> None:
    """Print what was wrong, and leave with 1 if anything was."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--first", type=int, default=0, help="number of the first mutant of each")
    parser.add_argument("--seals", action="store_true", help="of sealed files alone")
    options = parser.parse_args()
    clock = MonotonicClock()
    ends_at = clock.now() + options.seconds * NS_PER_S
    done = broken = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recordings = [] if options.seals else recording_kinds(folder / "recording")
        seal_broken = seal_breaker(folder / "sealed")
        for number in count(options.first):
            turns = [] if options.seals else [(kind, number) for kind in KINDS]
            if number % LOADERS_EACH == 0:
                turns += [(kind, number // LOADERS_EACH) for kind in recordings]
            for kind, mutant in turns:
                found = failures(kind, mutant, folder / kind.name)
                broken += bool(found)
                done += 1
                for text in found:
                    print(text, flush=True)
            found = seal_broken(number)
            broken += bool(found)
            done += 1
            for text in found:
                print(text, flush=True)
            if done >= options.inputs or clock.now() >= ends_at:
                break
    print(f"{done} mutated files, {broken} of them were not taken as they should be")
    raise SystemExit(broken > 0)


if __name__ == "__main__":
    main()
