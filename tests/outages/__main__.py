"""``python -m tests.outages``: runs whose adapter takes no frames, is down or loses what comes, drawn by a
seed, until the time is up or so many are done.

Looked for are false passes, cycles, readings and commands that are not accounted for as taps on the bus saw
them, and drives left turning. Leaves with 1 if there are any. ``--seed N`` repeats one, and ``--hub`` has
bench and drives as processes on a hub, in real time.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.outages import simulated
from tests.outages.hub import HubRuns
from tests.outages.outcome import Outcome


def main() -> None:
    """Print what was wrong, and the counts."""
    parser = argparse.ArgumentParser(prog="python -m tests.outages", description=__doc__)
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--runs", type=int, default=1000, help="no more than so many")
    parser.add_argument("--first", type=int, default=1, help="the seed of the first; the others follow")
    parser.add_argument("--seed", type=int, help="only this one")
    parser.add_argument("--hub", action="store_true", help="in real time, as processes on a hub")
    parser.add_argument("--flood", action="store_true", help="another program floods the adapter")
    given = parser.parse_args()
    first, runs = (given.first, given.runs) if given.seed is None else (given.seed, 1)
    if not given.hub:
        run = simulated.run_flooded if given.flood else simulated.run
        sys.exit(_draw(run, first, runs, given.seconds))
    with TemporaryDirectory() as folder, HubRuns(Path(folder)) as on_hub:
        sys.exit(_draw(on_hub.run, first, runs, given.seconds))


def _draw(run: Callable[[int], Outcome], first: int, runs: int, seconds: float) -> bool:
    """Whether anything was wrong."""
    clock = MonotonicClock()
    ends_at, seed = clock.now() + seconds * NS_PER_S, first
    sums: Counter[str] = Counter()
    statuses: Counter[str] = Counter()
    while seed < first + runs and clock.now() < ends_at:
        outcome = run(seed)
        statuses[str(outcome.status)] += 1
        sums.update(
            rows=outcome.rows,
            missed=outcome.missed,
            not_sent=outcome.not_sent,
            passed=outcome.passed,
            no_room=outcome.no_room,
            refused=outcome.refused,
        )
        sums["wrong"] += bool(outcome.wrong)
        for text in outcome.wrong:
            print(f"seed {seed}: {text}", flush=True)
        seed += 1
    ended = ", ".join(f"{count} with status {status}" for status, count in sorted(statuses.items()))
    print(
        f"{seed - first} runs from seed {first}: {sums['passed']} passed ({ended}); {sums['rows']} rows, "
        f"{sums['missed']} cycles without SYNC, {sums['not_sent']} commands not sent; "
        f"{sums['wrong']} runs broke something"
    )
    if sums["refused"]:
        print(
            f"the flood left no room within half a period for {sums['no_room']} SYNCs; "
            f"a sender that offers each but once would have lost {sums['refused']}"
        )
    return sums["wrong"] > 0


if __name__ == "__main__":
    main()
