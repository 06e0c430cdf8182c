"""``python -m tests.parameters``: every parameter of a drive of many data sheets saved, reset and loaded.

    python -m tests.parameters                       40 made-up sheets
    python -m tests.parameters --sheets FOLDER       and before them every EDS and DCF there
    python -m tests.parameters --only "no 6077h"     some made-up ones
    python -m tests.parameters --kills 8             ends of the host for each sheet
    python -m tests.parameters --scan                each saved without its sheet too

Settings are drawn, saved to a DCF and a concise one, reset (1011h) and loaded, the concise one also entry by
entry as a manager does; then the host ends at drawn writes, each time once undone and once gone on with.
Leaves with 1 if a drive holds another byte than it has to.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Final

from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.parameters.roundtrip import tried
from tests.rehearsals.rehearsal import made_sheet
from tests.witness.__main__ import SUFFIXES, drawn

MADE: Final = 40
KILLS: Final = 4
SHOWN: Final = 5


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(prog="python -m tests.parameters")
    parser.add_argument("--sheets", type=Path, help="a folder with data sheets")
    parser.add_argument("--made", type=int, default=MADE, help="so many made-up ones")
    parser.add_argument("--only", action="append", help="a trait, or two with + between")
    parser.add_argument("--kills", type=int, default=KILLS, help="for each sheet")
    parser.add_argument("--scan", action="store_true", help="save each without its sheet too")
    parser.add_argument("--seconds", type=float, default=1e9, help="what is not begun by then is left out")
    asked = parser.parse_args()
    clock = MonotonicClock()
    ends_at = clock.now() + asked.seconds * NS_PER_S
    given = [] if asked.sheets is None else sorted(asked.sheets.iterdir())
    cases: list[Path | tuple[str, ...]] = [each for each in given if each.suffix.lower() in SUFFIXES]
    cases += [tuple(name.split("+")) for name in asked.only or ()] or drawn(asked.made)
    sheets = refused = broken = parameters = kills = 0
    with tempfile.TemporaryDirectory() as name:
        for number, case in enumerate(cases):
            if clock.now() > ends_at:
                break
            folder = Path(name) / str(number)
            folder.mkdir()
            title = case.name if isinstance(case, Path) else " + ".join(case)
            try:
                sheet = case.absolute() if isinstance(case, Path) else made_sheet(case, folder)
            except KeyError:  # an object that the other trait took away
                print(f"{title[:50]:52}no sheet can have both")
                continue
            try:
                outcome = tried(sheet, folder, title, asked.kills, asked.scan)
            except PeerFault as error:
                refused += 1
                print(f"{title[:50]:52}refused: {error.evidence[:60]}", flush=True)
                continue
            sheets, parameters, kills = sheets + 1, parameters + outcome.parameters, kills + outcome.kills
            broken += bool(outcome.wrong)
            print(
                f"{title[:50]:52}{outcome.parameters:5} parameters, {outcome.drawn:4} drawn"
                f"{f'  <-- {len(outcome.wrong)} wrong' if outcome.wrong else ''}",
                flush=True,
            )
            print(
                *(f"    {text}" for text in outcome.wrong[:SHOWN]), sep="\n", end="\n" * bool(outcome.wrong)
            )
    counted = f"{parameters} parameters, {2 * kills} kills; {broken} wrong, {refused} no servo drive"
    print(f"{sheets} of {len(cases)} sheets, {counted}")
    raise SystemExit(broken > 0 or not sheets)


if __name__ == "__main__":
    main()
