"""``python -m tests.returns``: drawn drives that come back, and how fast their shafts went afterwards.

    python -m tests.returns --first 1000 --count 80    so many of each kind of axis, from that number on

Leaves with 1 if one was more than 5 % too fast, is not driven on, or ended its run.
"""

import argparse
import warnings

from servobench import run
from servobench.drivers.errors import BenchError
from tests.returns.drawn import AXES, drawn, returned


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(prog="python -m tests.returns")
    parser.add_argument("--first", type=int, default=1000, help="make test has the first few")
    parser.add_argument("--count", type=int, default=80)
    parser.add_argument("--axis", choices=AXES, action="append", help="this kind alone")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    numbers = range(given.first, given.first + given.count)
    wrong = sum([_told(axis, numbers) for axis in given.axis or AXES])
    raise SystemExit(wrong > 0)


def _told(axis: str, numbers: range) -> int:
    worst, wrong = 0.0, 0
    for number in numbers:
        try:
            found = returned(axis, number, run)
        except BenchError as error:
            text, bad = f"ended: {error}", True
        else:
            worst, bad = max(worst, found.overspeed), found.wrong
            text = f"{found.overspeed:.3f} of what it may be, {found.driven:.3f} of the reference at its end"
        wrong += bad
        if bad:
            print(f"  {axis} {number}: {text}; {drawn(axis, number)['faults']}", flush=True)
    print(f"{axis}: {len(numbers)} returns, {wrong} wrong, at most {worst:.3f}", flush=True)
    return wrong


if __name__ == "__main__":
    main()
