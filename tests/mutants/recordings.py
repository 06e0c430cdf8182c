"""The files of a recording whose logger was killed, as ``hil recover`` finds them."""

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.execution.recovered_run import recover_run, refuse_whole
from servobench.hil.recording.log_files import (
    EventsKeeper,
    FaultsKeeper,
    FramesKeeper,
    LoadKeeper,
    RecordsKeeper,
)
from servobench.hil.recording.logger_process import RecordingFailed
from servobench.hil.rows.events import ENTRY_DTYPE, FaultEntries
from servobench.hil.rows.side_rows import (
    FRAME,
    FRAME_DTYPE,
    BeginEvent,
    IdentityEvent,
    LoadEvent,
    RunEvent,
    StateEvent,
    TextEvent,
)
from servobench.hil.verdict.summary import summary_without_run
from servobench.hil.verdict.verdict import VerdictKind
from servobench.virtual_bus.faults.fault_log import read_line
from tests.mutants.kinds import BENCH, RECORDED
from tests.mutants.mutant import Kind
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records

CYCLES: Final = 40
EVENTS: Final[tuple[RunEvent, ...]] = (
    TextEvent(Instant(-5 * NS_PER_MS), "INFO", "axis1: node 1"),
    IdentityEvent(Instant(-4 * NS_PER_MS), "axis1", "a drive"),
    BeginEvent(Instant(0)),
    StateEvent(Instant(1), "phase", "running"),
    LoadEvent(Instant(NS_PER_MS), "axis1", 0.5, 10.0),
)


def write_unfinished(folder: Path) -> None:
    """A recording of some cycles, half of them in no batch yet."""
    folder.mkdir(parents=True)
    (folder / "bench.toml").write_text(BENCH)
    plan = plan_for(folder)
    rows = rows_of(synthetic_records(CYCLES))
    packed = [FRAME.pack(row["due_at"], 0x201, 4, 1, bytes(4)) for row in rows]
    frames = np.frombuffer(b"".join(packed), FRAME_DTYPE)
    records = RecordsKeeper(plan, folder)
    records.take(rows[: CYCLES // 2], frames[:0], EVENTS)
    records.flush()
    records.take(rows[CYCLES // 2 :], frames[:0], [])
    for keeper in (EventsKeeper(plan, folder), FramesKeeper(plan, folder), LoadKeeper(plan, folder)):
        keeper.take(rows, frames, EVENTS)
    injected = FaultsKeeper(folder, faults := FaultEntries(plan.started_at))
    faults.fresh = np.array(
        [read_line(line, "faults", n) for n, line in enumerate(RECORDED.splitlines(), start=1)], ENTRY_DTYPE
    )
    injected.take(rows, frames, EVENTS)
    whole = summary_without_run(VerdictKind.CUT_SHORT, "made up").as_json()
    (folder / "summary.json").write_text(json.dumps(whole))


def recording_kinds(folder: Path) -> list[Kind]:
    """A kind for each file of one recording; they work below ``folder``."""
    sound = folder / "sound"
    write_unfinished(sound)
    return [
        Kind(path.name, path.read_bytes(), _recovering(sound, folder / "run", path.name))
        for path in sorted(sound.iterdir())
    ]


def _recovering(sound: Path, run: Path, name: str) -> Callable[[Path], object]:
    """What ``hil recover`` does with a recording of which one file is another; 0, 2 and 5 are its ends."""

    def load(path: Path) -> None:
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(
            sound, run, ignore=shutil.ignore_patterns("" if name == "summary.json" else "summary.json")
        )
        shutil.copyfile(path, run / name)
        refuse_whole(run)
        with suppress(RecordingFailed):
            recover_run(load_bench(run / "bench.toml"), run)

    return load
