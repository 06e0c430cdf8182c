"""Files of a sealed recording and of a campaign's store with a bit flipped, cut off, or two bytes swapped.

Each is refused by file, soon and in little memory; what reads them all the same, by ``--unsealed``, ends as
documented.
"""

import os
import random
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

from typer.testing import CliRunner

from drivers.errors import BadInput
from hil.campaign import Campaign, run_campaign
from hil.cli import app
from hil.rows.seal import check_seal
from tests.mutants.mutant import PROCESSOR_S_MAX, processor_s
from tests.unit.hil.recorded_runs import BENCH, short_run

MEMORY_MAX_KB: Final = 500_000
"""That one mutant may cost."""
READ_EACH: Final = 20
"""Mutants for one that is read by ``--unsealed`` too, which takes so many times as long."""
STATUSES: Final = (0, 1, 2, 3, 4, 5, 6)
"""docs/verdict.md; 70 is a defect."""
READERS: Final = (
    ("export", "{}", "--to", "csv", "--out", os.devnull, "--unsealed"),
    ("review", "{}", "--unsealed"),
    ("trace", "{}", "--unsealed"),
    ("runs", "{}", "--unsealed"),
    ("compare", "{}", "{}", "--unsealed"),
)
SWEEP: Final = f"""
[campaign]
name = "mutated"
bench = "{BENCH}"
seeds = 4
failures_recorded = 0
[change]
"bench.duration_s" = 0.3
load = {{}}
"""


def mutated(data: bytes, draw: random.Random) -> bytes:
    """Other bytes than ``data``, which is not empty."""
    other = bytearray(data)
    while other == data:
        kind, at, to = draw.randrange(3), draw.randrange(len(data)), draw.randrange(len(data))
        if kind == 0:
            other[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del other[at:]
        else:
            other[at], other[to] = other[to], other[at]
    return bytes(other)


def seal_breaker(folder: Path) -> Callable[[int], list[str]]:
    """Makes a recording and a campaign in ``folder``; what is wrong with a mutant of one, by number."""
    run = short_run(folder / "run")
    sweep = folder / "sweep.toml"
    sweep.write_text(SWEEP)
    done = run_campaign(sweep, folder / "store", workers=1)
    kept = ("campaign.json", "seal", "runs/part-000000000.parquet")
    files = [run / path.name for path in sorted(run.iterdir()) if path.stat().st_size]
    readers: dict[Path, Callable[[], object]] = dict.fromkeys(files, partial(check_seal, run))
    readers |= dict.fromkeys([done.folder / name for name in kept], partial(_table, done))
    wholes = {path: path.read_bytes() for path in readers}

    def broken(number: int) -> list[str]:
        draw = random.Random(number)
        path = draw.choice(list(readers))
        path.write_bytes(mutated(wholes[path], draw))
        try:
            found = list(_wrong(path, readers[path], number, run))
        finally:
            path.write_bytes(wholes[path])
        return [f"seal, mutant {number} of {path}: {text}" for text in found]

    return broken


def _table(done: Campaign) -> None:
    Campaign(done.folder, done.plan).table.num_rows  # noqa: B018 - read anew


def _wrong(path: Path, read: Callable[[], object], number: int, run: Path) -> Iterator[str]:
    Path("/proc/self/clear_refs").write_text("5")  # from here on the most that this process has
    memory_kb, begun = _most_memory_kb(), processor_s()
    try:
        read()
        yield "it was accepted"
    except BadInput as error:
        if error.source != str(path):
            yield f"it was refused as {error}"
    if path.parent == run and number % READ_EACH == 0:
        for command in READERS:
            ended = CliRunner().invoke(app, [part.format(run) for part in command])
            if ended.exit_code not in STATUSES:
                yield f"{command[0]}: status {ended.exit_code}: {ended.output[-1000:]}"
    if (took_s := processor_s() - begun) > PROCESSOR_S_MAX * (1 if number % READ_EACH else len(READERS)):
        yield f"it took {took_s:.1f} s"
    if (more_kb := _most_memory_kb() - memory_kb) > MEMORY_MAX_KB:
        yield f"it took {more_kb} kB"


def _most_memory_kb() -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])
