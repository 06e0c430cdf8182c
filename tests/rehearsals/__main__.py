"""``python -m tests.rehearsals``: the table of outcomes of the made-up sheets, and of sheets of your own.

    python -m tests.rehearsals                    each trait alone, then pairs drawn from a seed
    python -m tests.rehearsals --only "no 6077h"  some of them; two with a + between are a pair
    python -m tests.rehearsals --sheets FOLDER    every EDS, DCF, XDD and XDC there

Leaves with 1 if a sheet ended otherwise than the trait says, if hil eds said another thing of it, if hil run
does not pass with the bench that was left, or if a drive was left moving, enabled or changed.
"""

import argparse
import random
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.rehearsals.rehearsal import Rehearsal, contradictions, made_sheet, ran, rehearsed
from tests.rehearsals.traits import TRAITS

SEED: Final = 16
SUFFIXES: Final = frozenset({".eds", ".dcf", ".xdd", ".xdc"})


def complaints(names: tuple[str, ...], result: Rehearsal) -> list[str]:
    """What is not as the traits say; of a pair any that ends commissioning may be its reason."""
    wrong = []
    if not result.is_safe():
        wrong.append(f"left {'enabled' if result.enabled else 'moving' if not result.stands else 'changed'}")
    finds = [TRAITS[name].finds for name in names if TRAITS[name].finds]
    wrong += [
        f"invented: {fault}"
        for fault in result.faults
        if not any(re.search(pattern, fault) for pattern in finds)
    ]
    ends = [TRAITS[name].ends for name in names if TRAITS[name].ends]
    if ends and (result.reason or not all(TRAITS[name].mendable for name in names if TRAITS[name].ends)):
        if not any(re.search(pattern, result.reason) for pattern in ends):
            wrong.append(f"another reason than {' or '.join(map(repr, ends))}")
        if result.moved:
            wrong.append("the shaft moved before it was told")
        return wrong
    if result.reason:
        wrong.append("was to be commissioned")
    expected = frozenset[str]().union(*(TRAITS[name].without for name in names))
    if result.not_done.keys() - expected:
        wrong.append(f"not done: {', '.join(sorted(result.not_done.keys() - expected))}")
    return wrong


def drawn_pairs() -> Iterator[tuple[str, ...]]:
    """Pairs without end, always the same ones."""
    draw = random.Random(SEED)
    while True:
        yield tuple(draw.sample(sorted(TRAITS), 2))


def _try(title: str, sheet: Path, folder: Path, names: tuple[str, ...] | None) -> bool:
    clock = MonotonicClock()
    began = clock.now()
    result = rehearsed(sheet, folder)
    wrong = complaints(names, result) if names is not None else [] if result.is_safe() else ["left unsafe"]
    wrong += contradictions(sheet, result)
    if failure := ran(folder):
        wrong.append(failure)
    took_s = (clock.now() - began) / NS_PER_S
    mark = f"  <-- {'; '.join(wrong)}" if wrong else ""
    print(f"{title:45} {took_s:5.1f} s  {result.row()}{mark}", flush=True)
    return bool(wrong)


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(prog="python -m tests.rehearsals")
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--pairs", type=int, default=len(TRAITS), help="no more than so many")
    parser.add_argument("--only", action="append", help="a trait, or two with + between")
    parser.add_argument("--sheets", type=Path, help="a folder with data sheets")
    given = parser.parse_args()
    clock = MonotonicClock()
    ends_at = clock.now() + given.seconds * NS_PER_S
    pairs = drawn_pairs()
    work: list[tuple[str, ...]] = [tuple(name.split("+")) for name in given.only or ()] or [
        *((name,) for name in TRAITS),
        *(next(pairs) for _ in range(given.pairs)),
    ]
    cases: list[Path | tuple[str, ...]] = [*(_sheets(given.sheets) if given.sheets else work)]
    tried = broken = 0
    with tempfile.TemporaryDirectory() as name:
        for number, case in enumerate(cases):
            if clock.now() > ends_at:
                break
            folder = Path(name) / str(number)
            folder.mkdir()
            tried += 1
            if isinstance(case, Path):
                broken += _try(case.name[:45], case, folder, None)
            else:
                broken += _try(" + ".join(case), made_sheet(case, folder), folder, case)
    print(f"{tried} sheets, {broken} of them not as they should be")
    raise SystemExit(broken > 0)


def _sheets(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)


if __name__ == "__main__":
    main()
