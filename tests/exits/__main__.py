"""``python -m tests.exits``: cells of the table in an order drawn by --seed, some at once, for so long."""

import argparse
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from random import Random

from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from tests.exits.cells import CELLS, Cell
from tests.exits.findings import findings
from tests.exits.one_run import Ended, run_cell

JOBS_MAX = 4
"""A cell waits for most of its time; with more at once a host would miss the deadlines of its own loop."""
STARTS = 3
"""Attempts to begin a cell, each in a minute; then it is left out of the table."""
LINE = "{:10}{:8}{:10}{:13}{:5}{:28}{:>7}{:>11}{:>10}"


def main() -> None:
    """Print the table and what was broken, and leave with 1 if anything was."""
    parser = argparse.ArgumentParser(prog="python -m tests.exits", description=__doc__)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--cells", default="", help="only those that have these words, e.g. 'hub host kill'")
    parser.add_argument("--seed", type=int, default=1, help="of the order")
    parser.add_argument("--first", type=int, default=0, help="place in that order to begin at")
    parser.add_argument("--jobs", type=int, choices=range(1, JOBS_MAX + 1), default=JOBS_MAX, help="at once")
    options = parser.parse_args()
    chosen = [cell for cell in CELLS if set(options.cells.split()) <= set(cell)]
    Random(options.seed).shuffle(chosen)
    ends_at = Instant(MonotonicClock().now() + round(options.seconds * NS_PER_S))
    done = broken = 0
    print(LINE.format("bus", "whom", "what", "phase", "mode", "outcome", "status", "rest [ms]", "rows lost"))
    with ProcessPoolExecutor(options.jobs) as pool:
        for told in pool.map(partial(run_before, ends_at), chosen[options.first :]):
            if told is None:
                break
            text, found = told
            done, broken = done + bool(text), broken + bool(found)
            print("\n".join(filter(None, (text, *found))), flush=True)
    print(f"{done} of {len(chosen)} cells, {broken} of them broke something")
    raise SystemExit(broken > 0)


def run_before(ends_at: Instant, cell: Cell) -> tuple[str, list[str]] | None:
    """Run a cell and return its line of the table, empty if it did not begin, and what it broke; None if the
    time is up."""
    for _ in range(STARTS):
        if MonotonicClock().now() > ends_at:
            return None
        with tempfile.TemporaryDirectory() as folder:
            try:
                ended = run_cell(cell, Path(folder))
            except PeerFault as error:  # the machine has too much to do to start a drive
                print(f"{cell}: {error}", flush=True)
                continue
            try:
                return line(ended), findings(ended)
            except ValueError as error:  # no object on stdout, or none in its files
                return str(cell), [f"{error!r}, status {ended.ran.case.status}: {ended.ran.case.said[-400:]}"]
    return "", []


def line(ended: Ended) -> str:
    """Of the table. Rest: from what befell it until the drive rests for good, by a witness in the drive."""
    verdict = ended.ran.told["verdict"]
    rest = "not seen" if ended.rest is None else f"{ended.rest / NS_PER_MS:.0f}"
    return LINE.format(*ended.cell, verdict["outcome"], verdict["exit_status"], rest, ended.lost)


if __name__ == "__main__":
    main()
