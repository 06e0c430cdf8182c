"""``python -m tests.swarm``: random runs until the time is up; ``--case N`` repeats one."""

import argparse
import tempfile
from pathlib import Path

from drivers.timebase import NS_PER_S, MonotonicClock
from tests.swarm.swarm import failures
from tests.swarm.test_swarm import CASES


def main() -> None:
    """Print what was broken, and leave with 1 if anything was."""
    parser = argparse.ArgumentParser(prog="python -m tests.swarm", description=__doc__)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--first", type=int, default=CASES, help="those below are run by make test")
    parser.add_argument("--case", type=int, help="only this one")
    options = parser.parse_args()
    if options.case is not None:
        raise SystemExit(_run(options.case) > 0)
    clock = MonotonicClock()
    ends_at = clock.now() + options.seconds * NS_PER_S
    number, broken = options.first, 0
    while clock.now() < ends_at:
        broken += _run(number)
        number += 1
    print(f"{number - options.first} runs, {broken} of them broke something")
    raise SystemExit(broken > 0)


def _run(number: int) -> int:
    with tempfile.TemporaryDirectory() as folder:
        found = failures(number, Path(folder))
    for text in found:
        print(text, flush=True)
    return bool(found)


if __name__ == "__main__":
    main()
