"""``python -m tests.mistakes``: a table of what became of drawn mistakes at a nameplate.

    python -m tests.mistakes --count 1000 --seed 1     so many mistakes, over the drives of 100 seeds
    python -m tests.mistakes --seconds 300             as many as fit in

    refused    before anything moved
    named      a finding or a failed step that the right plate does not have
    unproven   "a torque scale that nothing measured" stands in the place of "0 faults found"
    harmless   inertia and friction are right, and the figure is listed as the nameplate's alone
    right      inertia and friction are right
    WRONG      "0 faults found", and the inertia is off by more than 5 %

Leaves with 1 if one is WRONG, if less than 99 % are refused, named, unproven or harmless, or if a right plate
is refused.
"""

import argparse
import collections
import random
import tempfile
from pathlib import Path
from typing import Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.mistakes.drawn import Mistake, drawn_mistake, own_plate
from tests.mistakes.outcome import Outcome, RightPlate, outcome_of

DRIVES: Final = 100
GOOD: Final = ("refused", "named", "unproven", "harmless")
WANTED: Final = 0.99


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(prog="python -m tests.mistakes")
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1, help="of mistakes and drives")
    parser.add_argument("--drives", default=f"0-{DRIVES}", help="which of the hundred, for several processes")
    given = parser.parse_args()
    clock = MonotonicClock()
    ends_at = clock.now() + given.seconds * NS_PER_S
    draw = random.Random(f"{given.seed} {given.drives}")
    first, end = map(int, given.drives.split("-"))
    drives = [1000 * given.seed + number for number in range(first, end)]
    tally: collections.Counter[str] = collections.Counter()
    known: dict[int, RightPlate] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(given.count):
            seed, trust = drives[number % len(drives)], draw.random() < 0.5
            mistake = drawn_mistake(seed, draw)
            if clock.now() > ends_at:
                break
            if seed not in known:
                known[seed] = RightPlate(seed, folder)
            result = outcome_of(seed, mistake, trust, known[seed], folder)
            tally[result.verdict] += 1
            _tell(number, seed, trust, mistake, result)
    refused = {seed: right.refusal for seed, right in known.items() if right.refusal}
    for seed, refusal in refused.items():
        print(f"drive {seed}: its own plate {own_plate(seed)} is refused: {refusal}")
    done = sum(tally.values())
    good = sum(tally[each] for each in GOOD)
    print(f"{done} mistakes on {len(known)} drives: {_table(tally)}")
    print(f"{len(known)} right plates, {len(refused)} refused")
    raise SystemExit(tally["WRONG"] > 0 or good < WANTED * done or bool(refused))


def _table(tally: collections.Counter[str]) -> str:
    return ", ".join(f"{tally[each]} {each}" for each in (*GOOD, "right", "WRONG"))


def _tell(number: int, seed: int, trust: bool, mistake: Mistake, result: Outcome) -> None:
    if result.verdict in ("right", "WRONG", "unproven"):
        word = "trusted" if trust else "not trusted"
        print(f"{number}: drive {seed}, {mistake.text}, {word}: {result.verdict}, {result.why}", flush=True)


if __name__ == "__main__":
    main()
