"""``python -m tests.strangers``: strangers on a bus, drawn by a seed, and drawn worlds without any.

    forged   a single frame while connecting, one while running and one while stopping, in a quiet world and
             in one with losses: which are named, by kind and phase
    clean    worlds of ``tests.truth`` with losses, delays, duplicates, stalls, set clocks and adapters: what
             is taken for a stranger's

Half of the time each, or all of it for one. Leaves with 1 if less than 95 % of the forged frames of quiet
worlds are named, or anything in a clean world is.
"""

import argparse
import sys
from collections import Counter
from typing import Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.strangers.world import DURATION_S, clean_run, forged_run
from tests.truth.drawn import drawn_plan

WANTED: Final = 0.95
UNTOLD_EVERY: Final = 4
"""In one clean world of so many the bench is not told of duplicates."""


def main() -> None:
    """Both tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.strangers", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--first", type=int, default=1, help="the seed of the first; the others follow")
    parser.add_argument("--cycles", type=int, default=1500, help="of each axis of a clean world")
    parser.add_argument("--clean", type=int, help="show the clean world of this seed")
    parser.add_argument("--only", choices=("forged", "clean"))
    given = parser.parse_args()
    if given.clean is not None:
        _show(given.clean, given.cycles)
        return
    share_s = given.seconds if given.only else given.seconds / 2.0
    found = given.only == "clean" or _forged(given.first, share_s)
    calm = given.only == "forged" or _clean(given.first, share_s, given.cycles)
    sys.exit(not (found and calm))


def _forged(first: int, seconds: float) -> bool:
    ends_at, seed = MonotonicClock().now() + seconds * NS_PER_S, first
    sent: Counter[tuple[str, str, str]] = Counter()
    named: Counter[tuple[str, str, str]] = Counter()
    ended = 0
    while MonotonicClock().now() < ends_at:
        world = [*DURATION_S][seed % 4 == 0]
        run = forged_run(seed, world)
        ended += bool(run.ended_by)
        sent.update((world, each.kind, each.phase) for each in run.forgeries)
        named.update((world, each.kind, each.phase) for each in run.named)
        seed += 1
    for key in sorted(sent):
        print(f"{' | '.join(key):45} {named[key]:5} of {sent[key]:5} named")
    for world in DURATION_S:
        total = sum(count for key, count in sent.items() if key[0] == world)
        right = sum(count for key, count in named.items() if key[0] == world)
        print(
            f"{world}: {right} of {total} single forged frames named ({100.0 * right / max(total, 1):.1f} %)"
        )
    print(f"{seed - first} runs from seed {first}, {ended} ended by what was forged")
    quiet = [key for key in sent if key[0] == "quiet"]
    return sum(named[key] for key in quiet) >= WANTED * sum(sent[key] for key in quiet)


def _clean(first: int, seconds: float, cycles: int) -> bool:
    ends_at, seed, done, alarms, failed = MonotonicClock().now() + seconds * NS_PER_S, first, 0, 0, 0
    while MonotonicClock().now() < ends_at:
        run = clean_run(drawn_plan(seed), cycles, untold=seed % UNTOLD_EVERY == 0)
        done, failed = done + run.cycles, failed + bool(run.ended_by)
        for alarm in run.alarms:
            alarms += 1
            print(f"clean world {seed}: {alarm}", flush=True)
        seed += 1
    worlds = seed - first
    print(
        f"clean: {alarms} false alarms in {done} cycles of {worlds} worlds from seed {first}, {failed} ended"
    )
    return not alarms


def _show(seed: int, cycles: int) -> None:
    plan = drawn_plan(seed)
    for name, words in zip(plan.features, plan.words, strict=True):
        print(f"  {name:26} {words}")
    run = clean_run(plan, cycles, untold=seed % UNTOLD_EVERY == 0)
    print(run.ended_by or "not ended")
    for alarm in run.alarms:
        print(f"  {alarm}")


if __name__ == "__main__":
    main()
