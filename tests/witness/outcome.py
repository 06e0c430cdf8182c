"""One sheet tried and judged, and its lines of the table."""

import shutil
from pathlib import Path
from typing import Final, NamedTuple

from tests.rehearsals.made_sheet import MadeSheet
from tests.rehearsals.traits import TRAITS
from tests.witness.allowed import documented
from tests.witness.case import Case, tried
from tests.witness.judgement import Judged, judged


class Sheet(NamedTuple):
    """One to be tried."""

    title: str
    path: Path
    names: tuple[str, ...] | None
    """Its traits; None: nobody knows them."""
    folder: Path


class Outcome(NamedTuple):
    """What came of one."""

    sheet: Sheet
    case: Case
    judged: Judged
    tries: int = 1


def outcome(sheet: Sheet, hub: str) -> Outcome:
    """Try it and judge it."""
    shutil.rmtree(sheet.folder, ignore_errors=True)
    sheet.folder.mkdir(parents=True)
    case = tried(sheet.path, sheet.folder, hub)
    return Outcome(sheet, case, judged(case, _touched(sheet.names), _is_sound(sheet.names), documented()))


def _touched(names: tuple[str, ...] | None) -> frozenset[int] | None:
    if names is None:
        return None
    made = MadeSheet()
    for name in names:
        TRAITS[name].change(made)
    return made.touched(MadeSheet())


def _is_sound(names: tuple[str, ...] | None) -> bool:
    """Nothing in it keeps a bench from commissioning the drive."""
    return names is not None and not any(TRAITS[name].ends for name in names)


def row(result: Outcome) -> str:
    """One line of the table."""
    case, run = result.case, result.case.run
    commission = case.commission
    steps = commission.figures.get("steps", ())
    done = sum(step["verdict"] == "done" for step in steps)
    ends = "refused" if commission.figures.get("error") else f"{done}/{len(steps)} done"
    ran = "-" if run is None else {0: "passed"}.get(run.status, f"exit {run.status}")
    writes = sum(access.writes for accesses in case.accesses.values() for access in accesses)
    found = result.judged
    counts = [len(each) for each in (found.unasked, found.contradictions, found.false_reasons, found.unsafe)]
    return (
        f"{result.sheet.title[:44]:44} {'serves' if case.eds.status == 0 else 'not':6} {ends:11} {ran:7} "
        f"{writes:6} {' '.join(f'{count:3}' for count in counts)} {case.seconds:5.0f}"
        f"{f' try {result.tries}, alone' if result.tries > 1 else ''}"
    )


HEAD: Final = (
    f"{'sheet':44} {'eds':6} {'commission':11} {'run':7} {'writes':>6} una con fal lef     s\n"
    "una: writes that no list allows; con: contradictions; fal: false reasons; lef: wrong in how it was left"
)


def report(result: Outcome) -> None:
    """Print it."""
    print(row(result), flush=True)
    for options in (ended.options for ended in result.case.commissions[1:]):
        print(f"    as advised: {' '.join(options) or 'the nameplate mended'}")
    for text in (result.case.commission.reason, result.case.run.reason if result.case.run else ""):
        if text:
            print(f"    {text}")
    for text in result.judged.wrong:
        print(f"    <-- {text}")
    for text in result.judged.late:
        print(f"    no time: {text}")
