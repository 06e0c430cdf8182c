"""``python -m tests.witness``: given and made-up data sheets through the three commands on the hub.

    python -m tests.witness                        40 made-up ones
    python -m tests.witness --sheets FOLDER        and before them every EDS and DCF there
    python -m tests.witness --only "6083h is 0"    some made-up ones; two with a + between are a pair
    python -m tests.witness --out DIR              keep what the commands left, and the logs of the frames
    python -m tests.witness --seconds 400 --first 7
                                                   as many as fit, of the made-up ones from the eighth on

Leaves with 1 if something was written that no list allows, the commands contradict each other, a reason is
false, or a drive was left moving, enabled or changed; or if the machine had no time for too many sheets.

What a command wrote, read, said of the drive's objects and left behind is judged, however late the machine
was. How a motion or a run ended is judged where the frames show that the machine kept its time; a sheet for
which it did not is tried again, alone, and so is one of which a motion alone is wrong: it counts if it is
wrong each time.
"""

import argparse
import os
import random
import tempfile
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context
from pathlib import Path
from typing import Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.rehearsals.rehearsal import made_sheet
from tests.rehearsals.traits import TRAITS
from tests.witness.outcome import HEAD, Outcome, Sheet, outcome, report

MADE: Final = 40
SEED: Final = 34
SIDE_BY_SIDE: Final = 4
"""They wait most of the time: one takes some 15 s of a core, and 65 s."""
TRIES_MAX: Final = 3
AGAIN_SHARE: Final = 0.3
"""Of the time: kept for those that are tried again."""
LATE_SHARE_MAX: Final = 0.1
"""Of the sheets: so many may be left of which no motion could be judged, else nothing was shown of motion."""
SUFFIXES: Final = frozenset({".eds", ".dcf"})
SINGLES: Final = (
    "profile 0 in 1000h",
    "profile 2065 in 1000h",
    "2100h:01 a serial number",
    "2100h:01 a brake's time",
    "6083h is 0",
    "6083h is tiny",
    "6083h is limited",
    "6083h is 1 at most",
    "6084h is 0",
    "6085h is 0",
    "no 6084h",
    "60C5h is tiny",
    "6087h is 0",
    "6087h is 10000 at most",
    "6087h is 1000 at most",
    "608Fh is 1/1",
    "608Fh is 1/1, 6094h",
    "608Fh is 1/1, 6094h, 6097h",
    "6502h is 43h, 6060h 7",
    "6502h with velocity mode only",
    "6502h with interpolated position only",
    "6502h with positions only",
    "6502h with positions only, no 607Ah",
    "6502h with homing only",
    "6502h without torque",
    "no 6502h",
    "no units",
    "no 606Ch",
    "606Ch not mappable",
    "6077h not mappable",
    "no 6061h",
    "6061h not mappable",
    "a maker's object in a fixed RPDO",
    "mappings fixed for torque",
    "mappings fixed, no values",
    "one TPDO",
    "no event timers",
    "a second axis",
    "mappings refused at sub 1",
    "EMCY 2310h again and again",
)


def drawn(count: int) -> Iterator[tuple[str, ...]]:
    """The single traits, then pairs from a seed: always the same ones."""
    draw = random.Random(SEED)
    for number in range(count):
        yield (SINGLES[number],) if number < len(SINGLES) else tuple(draw.sample(sorted(TRAITS), 2))


def _given(folder: Path | None) -> list[Path]:
    if folder is None or not folder.is_dir():
        print("no folder of vendors' data sheets: left out, the made-up ones only", flush=True)
        return []
    return sorted(path.absolute() for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)


def _sheets(given: list[Path], made: list[tuple[str, ...]], folder: Path) -> Iterator[Sheet]:
    for number, path in enumerate(given):
        yield Sheet(path.name, path, None, folder / f"given{number}")
    for number, names in enumerate(made):
        own = folder / f"made{number}"
        own.mkdir(parents=True, exist_ok=True)
        sheet = made_sheet(names, own).rename(folder / f"made{number}.eds")
        yield Sheet(" + ".join(names), sheet, names, own)


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(prog="python -m tests.witness")
    parser.add_argument("--sheets", type=Path, help="a folder with data sheets")
    parser.add_argument("--made", type=int, default=MADE, help="so many made-up ones")
    parser.add_argument("--only", action="append", help="a trait, or two with + between")
    parser.add_argument("--out", type=Path, help="what the commands left")
    parser.add_argument("--side-by-side", type=int, default=SIDE_BY_SIDE)
    parser.add_argument("--seconds", type=float, default=1800.0, help="what is not begun by then is left out")
    parser.add_argument("--first", type=int, default=0, help="the made-up one to begin with; the rest after")
    asked = parser.parse_args()
    clock = MonotonicClock()
    began = clock.now()
    made = [tuple(name.split("+")) for name in asked.only or ()] or list(drawn(asked.made))
    first = asked.first % len(made) if made else 0
    made = made[first:] + made[:first]
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.out or Path(name)).absolute()
        sheets = list(_sheets([] if asked.only else _given(asked.sheets), made, folder))
        results = _all(sheets, asked.side_by_side, began, round(asked.seconds * NS_PER_S))
    wrong = [result for result in results if result.judged.wrong]
    for result in wrong:
        print(f"not as it should be: {result.sheet.title}")
        print(*(f"    <-- {text}" for text in result.judged.wrong), sep="\n")
    late = sum(bool(result.judged.late) for result in results)
    print(
        f"{len(results)} of {len(sheets)} sheets, {len(wrong)} not as they should be, "
        f"{late} whose motion the machine had no time for; {(clock.now() - began) / NS_PER_S:.0f} s"
    )
    raise SystemExit(not results or bool(wrong) or late > LATE_SHARE_MAX * len(results))


def _all(sheets: list[Sheet], side_by_side: int, began: int, span: int) -> list[Outcome]:
    print(HEAD, flush=True)
    clock = MonotonicClock()
    last_begins_at = began + round((1.0 - AGAIN_SHARE) * span)
    results: list[Outcome] = []
    with ProcessPoolExecutor(side_by_side, get_context("spawn")) as pool:
        waiting = list(enumerate(sheets))[::-1]
        tried: set[Future[Outcome]] = set()
        while tried or (waiting and clock.now() < last_begins_at):
            while waiting and len(tried) < side_by_side and clock.now() < last_begins_at:
                number, sheet = waiting.pop()
                tried.add(pool.submit(outcome, sheet, f"witness{os.getpid()}-{number}"))
            done, tried = wait(tried, return_when=FIRST_COMPLETED)
            for ended in done:
                results.append(ended.result())
                report(results[-1])
    for tries in range(2, TRIES_MAX + 1):
        for number, result in enumerate(results):
            again = result.judged.is_to_be_tried_again
            if again and (result.judged.motion or clock.now() < began + span):
                hub = f"witness{os.getpid()}-{number}-{tries}"
                results[number] = outcome(result.sheet, hub)._replace(tries=tries)
                report(results[number])
    return results


if __name__ == "__main__":
    main()
