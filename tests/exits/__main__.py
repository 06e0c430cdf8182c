"""``python -m tests.exits``: the table, cell by cell in an order drawn by --seed, until the time is up."""

import argparse
import tempfile
from collections.abc import Iterable
from pathlib import Path
from random import Random

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, MonotonicClock
from tests.exits.cells import CELLS, Cell
from tests.exits.findings import findings
from tests.exits.one_run import Ended, run_cell

LINE = "{:10}{:8}{:10}{:13}{:5}{:28}{:>7}{:>11}{:>10}"


def main() -> None:
    """Print the table and what was broken, and leave with 1 if anything was."""
    parser = argparse.ArgumentParser(prog="python -m tests.exits", description=__doc__)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--cells", default="", help="only those that have these words, e.g. 'hub host kill'")
    parser.add_argument("--seed", type=int, default=1, help="of the order")
    options = parser.parse_args()
    chosen = [cell for cell in CELLS if set(options.cells.split()) <= set(cell)]
    Random(options.seed).shuffle(chosen)
    clock = MonotonicClock()
    ends_at = clock.now() + options.seconds * NS_PER_S
    lines: dict[Cell, str] = {}
    broken = 0
    for cell in chosen:
        if clock.now() > ends_at:
            break
        with tempfile.TemporaryDirectory() as folder:
            ended = run_cell(cell, Path(folder))
            found = findings(ended)
            lines[cell] = line(ended)
        broken += bool(found)
        for text in found:
            print(f"{cell}: {text}", flush=True)
    print_table(lines[cell] for cell in CELLS if cell in lines)
    print(f"{len(lines)} of {len(chosen)} cells, {broken} of them broke something")
    raise SystemExit(broken > 0)


def line(ended: Ended) -> str:
    """Of the table."""
    verdict = ended.ran.told["verdict"]
    rest = "not seen" if ended.rest is None else f"{ended.rest / NS_PER_MS:.0f}"
    return LINE.format(*ended.cell, verdict["outcome"], verdict["exit_status"], rest, ended.lost)


def print_table(lines: Iterable[str]) -> None:
    """Rest: from what befell it until the drive was at rest for good, as a witness in the drive saw it."""
    print(LINE.format("bus", "whom", "what", "phase", "mode", "outcome", "status", "rest [ms]", "rows lost"))
    for text in lines:
        print(text)


if __name__ == "__main__":
    main()
