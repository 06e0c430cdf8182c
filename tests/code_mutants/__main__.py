"""``python -m tests.code_mutants``: the safety mutants, then a sample of all others.

Leaves with 1 if a safety mutant survives that is not argued equivalent, or an argument is stale.
"""

import argparse
from collections import Counter
from typing import Final

from drivers.timebase import NS_PER_S, MonotonicClock
from tests.code_mutants.argued import Arguments, read_arguments
from tests.code_mutants.mutations import Mutant, Place
from tests.code_mutants.safety import Guarded, safety_set
from tests.code_mutants.sample import ROOMS, callers, calls_of, room_of, sample, unit_tests
from tests.code_mutants.workshop import ROOT, Fate, Workshop, workshop

SUITE: Final = [
    "tests",
    *(f"--ignore=tests/{part}" for part in ("vcan", "dask", "code_mutants", "test_tidy.py")),
]
"""All that may see a mutant, without what looks at the text of the sources."""
SUITE_TIMEOUT_S: Final = 3600.0


def main() -> None:
    """Print who survived, and the counts."""
    parser = argparse.ArgumentParser(prog="python -m tests.code_mutants", description=__doc__)
    parser.add_argument("--only", default="", help="safety mutants of files whose name holds this, no sample")
    parser.add_argument("--sample", type=int, default=200, help="mutants drawn from all lines; 0: none")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1e9, help="of the sample, at most")
    parser.add_argument("--suite", action="store_true", help="hold the sample's survivors against all tests")
    options = parser.parse_args()
    with workshop() as shop:
        broken = _hold_safety(shop, options.only)
        if options.sample and not options.only:
            _hold_sample(shop, options)
    raise SystemExit(broken)


def _hold_safety(shop: Workshop, only: str) -> bool:
    """Whether one survived unargued, or an argument is stale."""
    chosen = [(guarded, mutants) for guarded, mutants in safety_set() if only in guarded.file]
    arguments = read_arguments()
    arguments.why = {place: why for place, why in arguments.why.items() if only in place.file}
    survivors: list[Mutant] = []
    done = argued = 0
    for guarded, mutants in chosen:
        timeout_s = shop.check(_there(guarded))
        print(f"{guarded.file} {', '.join(guarded.functions)}: {len(mutants)} mutants", flush=True)
        for mutant in mutants:
            done += 1
            if shop.fate_of(mutant, _there(guarded), timeout_s) is Fate.KILLED:
                continue
            if arguments.holds(mutant.place):
                argued += 1
            else:
                survivors.append(mutant)
                print(f"survived  {mutant}", flush=True)
    stale = _stale(arguments, chosen)
    for text in stale:
        print(f"stale     {text}")
    killed = done - argued - len(survivors)
    print(f"{done} safety mutants: {killed} killed, {argued} argued equivalent, {len(survivors)} survive")
    return bool(survivors or stale)


def _there(guarded: Guarded) -> list[str]:
    missing = [test for test in guarded.tests if not (ROOT / test).is_file()]
    if missing:
        raise SystemExit(f"{missing[0]} is not there any more: mend tests/code_mutants/safety.py")
    return list(guarded.tests)


def _stale(arguments: Arguments, chosen: list[tuple[Guarded, list[Mutant]]]) -> list[str]:
    seen: list[Place] = [mutant.place for _, mutants in chosen for mutant in mutants]
    return arguments.stale(seen)


def _hold_sample(shop: Workshop, options: argparse.Namespace) -> None:
    clock = MonotonicClock()
    calls = calls_of(shop, [test for room in ROOMS for test in unit_tests(room)])
    ends_at = clock.now() + options.seconds * NS_PER_S
    by_room: Counter[tuple[str, Fate]] = Counter()
    survivors = []
    for mutant, _ in zip(sample(options.seed), range(options.sample), strict=False):
        if clock.now() >= ends_at:
            break
        room = room_of(mutant)
        tests = callers(mutant, calls, room)
        fate = shop.fate_of(mutant, tests) if tests else Fate.SURVIVED
        by_room[room, fate] += 1
        if fate is Fate.SURVIVED:
            survivors.append(mutant)
            print(f"survived  {mutant}{'' if tests else ' (no unit test calls it)'}", flush=True)
    for room in ROOMS:
        killed, survived = by_room[room, Fate.KILLED], by_room[room, Fate.SURVIVED]
        print(f"{room:<12} {killed:4} killed by its unit tests, {survived:4} survive")
    done = by_room.total()
    print(f"seed {options.seed}: {done - len(survivors)} of {done} killed by their rooms' unit tests")
    if options.suite:
        left = [each for each in survivors if shop.fate_of(each, SUITE, SUITE_TIMEOUT_S) is Fate.SURVIVED]
        for mutant in left:
            print(f"survived all tests  {mutant}")
        print(f"seed {options.seed}: {done - len(left)} of {done} killed by the whole suite")


if __name__ == "__main__":
    main()
