"""``python -m tests.witness``: given and made-up data sheets through the three commands on the hub.

    python -m tests.witness                        40 made-up ones
    python -m tests.witness --sheets FOLDER        and before them every EDS and DCF there
    python -m tests.witness --only "6083h is 0"    some made-up ones; two with a + between are a pair
    python -m tests.witness --out DIR              keep what the commands left, and the logs of the frames

Leaves with 1 if something was written that no list allows, the commands contradict each other, a reason is
false, or a drive was left moving, enabled or changed; or if the machine had no time for too many sheets.

What a command wrote, read, said of the drive's objects and left behind is judged, however late the machine
was. How a motion or a run ended is judged where the frames show that the machine kept its time; a sheet for
which it did not is tried again, alone.
"""

import argparse
import os
import random
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Final

from drivers.timebase import NS_PER_S, MonotonicClock
from tests.rehearsals.rehearsal import made_sheet
from tests.rehearsals.traits import TRAITS
from tests.witness.outcome import HEAD, Outcome, Sheet, outcome, report

MADE: Final = 40
SEED: Final = 34
SIDE_BY_SIDE: Final = 4
"""They wait most of the time: one takes some 15 s of a core, and 65 s."""
TRIES_MAX: Final = 3
AGAIN_S: Final = 600
"""For all that are tried again: CI has no time without end."""
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
    asked = parser.parse_args()
    clock = MonotonicClock()
    began = clock.now()
    made = [tuple(name.split("+")) for name in asked.only or ()] or list(drawn(asked.made))
    with tempfile.TemporaryDirectory() as name:
        folder = (asked.out or Path(name)).absolute()
        sheets = list(_sheets([] if asked.only else _given(asked.sheets), made, folder))
        results = _all(sheets, asked.side_by_side)
    wrong = [result for result in results if result.judged.wrong]
    for result in wrong:
        print(f"not as it should be: {result.sheet.title}")
        print(*(f"    <-- {text}" for text in result.judged.wrong), sep="\n")
    late = sum(bool(result.judged.late) for result in results)
    print(
        f"{len(results)} sheets, {len(wrong)} not as they should be, "
        f"{late} whose motion the machine had no time for; {(clock.now() - began) / NS_PER_S:.0f} s"
    )
    raise SystemExit(bool(wrong) or late > LATE_SHARE_MAX * len(results))


def _all(sheets: list[Sheet], side_by_side: int) -> list[Outcome]:
    print(HEAD, flush=True)
    hubs = [f"witness{os.getpid()}-{number}" for number in range(len(sheets))]
    results: list[Outcome] = []
    with ProcessPoolExecutor(side_by_side, get_context("spawn")) as pool:
        for result in pool.map(outcome, sheets, hubs):
            results.append(result)
            report(result)
    clock = MonotonicClock()
    ends_at = clock.now() + AGAIN_S * NS_PER_S
    for tries in range(2, TRIES_MAX + 1):
        for number, result in enumerate(results):
            if result.judged.late and not result.judged.wrong and clock.now() < ends_at:
                hub = f"witness{os.getpid()}-{number}-{tries}"
                results[number] = outcome(result.sheet, hub)._replace(tries=tries)
                report(results[number])
    return results


if __name__ == "__main__":
    main()
