"""``python -m tests.swarm``: random runs whose processes or disk are struck, until the time is up.

``--case N`` repeats one. All those that need no processes are a campaign: swarm.toml.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.swarm.swarm import failures, is_struck, warm

CASES: Final = 24
"""Those that ``make test`` runs."""
UNSTRUCK_EVERY: Final = 20
"""Of the numbers one in so many goes through processes though nothing strikes it: command line and logger see
undisturbed runs as well."""


def main() -> None:
    """Print what was broken, and leave with 1 if anything was."""
    parser = argparse.ArgumentParser(prog="python -m tests.swarm", description=__doc__)
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--first", type=int, default=CASES, help="those below are run by make test")
    parser.add_argument("--cases", type=int, help="no more than so many")
    parser.add_argument("--case", type=int, help="only this one")
    options = parser.parse_args()
    first, count = (options.case, 1) if options.case is not None else (options.first, options.cases)
    clock = MonotonicClock()
    ends_at = clock.now() + options.seconds * NS_PER_S
    warm()
    number, ran, broken = first, 0, 0
    while clock.now() < ends_at and number - first != count:
        if is_struck(number) or number % UNSTRUCK_EVERY == 0 or number == options.case:
            ran += 1
            broken += _run(number)
        number += 1
    print(f"{ran} runs, {broken} of them broke something")
    raise SystemExit(broken > 0)


def _run(number: int) -> int:
    with tempfile.TemporaryDirectory() as folder:
        found = failures(number, Path(folder))
    for text in found:
        print(text, flush=True)
    return bool(found)


if __name__ == "__main__":
    main()
