"""``python -m tests.code_mutants``: the safety mutants, then a sample of all others.

Leaves with 1 if a safety mutant survives that is not argued equivalent, or an argument is stale.
"""

import argparse
from collections import Counter
from dataclasses import asdict
from functools import partial
from itertools import islice

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.code_mutants.argued import read_arguments
from tests.code_mutants.imports import ROOMS
from tests.code_mutants.mutations import Mutant
from tests.code_mutants.safety import Guarded, safety_set
from tests.code_mutants.sample import (
    Called,
    Calls,
    Kept,
    called_by,
    callers,
    judged,
    killer,
    others,
    room_of,
    sample,
    slow,
    tests_in,
)
from tests.code_mutants.workshop import ROOT, Fate, Workshop, Workshops, workshops


def main() -> None:
    """Print who survived, and the counts."""
    parser = argparse.ArgumentParser(prog="python -m tests.code_mutants", description=__doc__)
    parser.add_argument("--only", default="", help="safety mutants of files whose name holds this, no sample")
    parser.add_argument("--sample", type=int, default=200, help="mutants drawn from all lines; 0: none")
    parser.add_argument("--sample-only", action="store_true", help="no safety mutants")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1e9, help="of the sample, at most")
    parser.add_argument(
        "--suite",
        type=float,
        default=0.0,
        help="seconds for which each survivor is held against all other tests",
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes side by side")
    options = parser.parse_args()
    with workshops(options.jobs) as shops:
        broken = not options.sample_only and _hold_safety(shops, options.only)
        if options.sample and not options.only:
            _hold_sample(shops, options)
    raise SystemExit(broken)


def _hold_safety(shops: Workshops, only: str) -> bool:
    """Whether one survived unargued, or an argument is stale."""
    chosen = [(guarded, mutants) for guarded, mutants in safety_set() if only in guarded.file]
    arguments = read_arguments()
    arguments.why = {place: why for place, why in arguments.why.items() if only in place.file}
    left = [mutant for survivors in shops.map(_survivors, chosen) for mutant in survivors]
    unargued = [mutant for mutant in left if not arguments.holds(mutant.place)]
    for mutant in unargued:
        print(f"survived  {mutant}", flush=True)
    stale = arguments.stale(mutant.place for _, mutants in chosen for mutant in mutants)
    for text in stale:
        print(f"stale     {text}")
    done = sum(len(mutants) for _, mutants in chosen)
    print(
        f"{done} safety mutants: {done - len(left)} killed, {len(left) - len(unargued)} argued equivalent, ",
        end="",
    )
    print(f"{len(unargued)} survive", flush=True)
    return bool(unargued or stale)


def _survivors(shop: Workshop, entry: tuple[Guarded, list[Mutant]]) -> list[Mutant]:
    guarded, mutants = entry
    tests = _there(guarded)
    timeout_s = shop.check(tests)
    left = [mutant for mutant in mutants if shop.fate_of(mutant, tests, timeout_s) is Fate.SURVIVED]
    told = f"{len(mutants)} mutants, {len(left)} left by the tests"
    print(f"{guarded.file} {', '.join(guarded.functions)}: {told}", flush=True)
    return left


def _there(guarded: Guarded) -> list[str]:
    missing = [test for test in guarded.tests if not (ROOT / test).is_file()]
    if missing:
        raise SystemExit(f"{missing[0]} is not there any more: mend tests/code_mutants/safety.py")
    return list(guarded.tests)


def _hold_sample(shops: Workshops, options: argparse.Namespace) -> None:
    clock = MonotonicClock()
    kept = Kept()
    calls = _calls(shops, kept)
    ends_at = clock.now() + options.seconds * NS_PER_S

    def hold(shop: Workshop, mutant: Mutant) -> tuple[Mutant, Fate, str] | None:
        if clock.now() >= ends_at:
            return None
        own = f"tests/unit/{room_of(mutant)}/"
        tests = callers(mutant, calls)
        home = [test for test in tests if test.startswith(own)]
        late = [test for test in slow(mutant, calls) if test.startswith(own)]
        fate = Fate.SURVIVED
        for judges in filter(None, (home, late)):
            if fate is Fate.SURVIVED:
                fate = Fate(kept.answer([str(mutant)], judges, partial(judged, shop, mutant, judges, calls)))
        by = ""
        if fate is Fate.SURVIVED and options.suite:
            beyond = [test for test in tests + slow(mutant, calls) if not test.startswith(own)] + others(
                mutant
            )
            question = [str(mutant), f"{options.suite} s"]
            by = kept.answer(question, beyond, lambda: killer(shop, mutant, beyond, options.suite))
        if fate is Fate.SURVIVED:
            print(f"survived  {mutant}{'' if home or late else ' (no unit test calls it)'}", end="")
            print(f"  killed by {by}" if by else "", flush=True)
        return mutant, fate, by

    drawn = islice(sample(options.seed), options.sample)
    done = [each for each in shops.map(hold, drawn) if each is not None]
    by_room = Counter((room_of(mutant), fate) for mutant, fate, _ in done)
    for room in ROOMS:
        killed, survived = by_room[room, Fate.KILLED], by_room[room, Fate.SURVIVED]
        print(f"{room:<12} {killed:4} killed by its unit tests, {survived:4} survive")
    killed = sum(fate is Fate.KILLED for _, fate, _ in done)
    print(f"seed {options.seed}: at least {killed} of {len(done)} killed by their rooms' unit tests")
    if options.suite:
        killed += sum(bool(by) for _, _, by in done)
        print(f"seed {options.seed}: at least {killed} of {len(done)} killed by the whole suite")


def _calls(shops: Workshops, kept: Kept) -> Calls:
    """Of all unit tests: some minutes, and kept for each test file until what it reaches changes."""
    tests = tests_in("tests/unit")

    def look(shop: Workshop, test: str) -> Called:
        return Called(**kept.answer(["calls"], [test], lambda: asdict(called_by(shop, test))))

    calls = {}
    for test, called in zip(tests, shops.map(look, tests), strict=True):
        calls[test] = called
        print(f"\r  what the unit tests call: {len(calls)} of {len(tests)} files", end="", flush=True)
    print()
    return calls


if __name__ == "__main__":
    main()
