"""A case of the swarm that was run: what it says of itself, its recording, and its witnesses."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from servobench import Run
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.records_file import read_metadata, read_records
from servobench.hil.rows.run_files import FIRST_CYCLE, RECORDS_FILE, SUMMARY_FILE
from servobench.hil.testing.wire import Wire, read_wire
from tests.swarm.mishaps import Circumstances, Mishap
from tests.swarm.witness import Testimony

STATUSES: Final = (0, 1, 3, 4, 5, 6)
"""docs/exit-status.md; a drawn bench is never bad input, and nobody interrupts it."""
TELLING_NS: Final = NS_PER_MS
"""What is told at the very end has no frame of its own."""


class Told(NamedTuple):
    """What a case has to say of itself."""

    status: int | None
    """None: it was killed."""
    out: str
    said: str
    drives: list[Testimony]
    killed_at: Instant | None = None
    """On the bench's clock."""
    logger_status: int | None = None
    recovered: int | None = None
    """Status of ``hil recover``."""


@dataclass(frozen=True)
class Ran:
    """A case that was run, with its recording and its witnesses."""

    config: BenchConfig
    circumstances: Circumstances
    folder: Path
    case: Told
    statuses: Sequence[int] = STATUSES
    """With which it may have ended."""
    telling_ns: int = TELLING_NS

    @property
    def survived(self) -> bool:
        """The host has come to its end."""
        return self.case.status is not None

    @cached_property
    def told(self) -> dict[str, Any]:
        """The object of --json; of a host that was killed, that of summary.json."""
        out = self.case.out if self.survived else (self.folder / SUMMARY_FILE).read_text(encoding="utf-8")
        found: dict[str, Any] = json.loads(out)
        return found

    @property
    def whole(self) -> bool:
        """Nothing is known to be missing in the recording."""
        return not self.told.get("recording_faults") and (self.folder / SUMMARY_FILE).exists()

    @property
    def has_all_rows(self) -> bool:
        """None was lost with a disk; those that a logger has not taken lie in memory."""
        return self.circumstances.mishap is not Mishap.DISK_FULL

    @cached_property
    def rows(self) -> Rows:
        """(n,) of all axes; none where the run never began."""
        if not (self.folder / RECORDS_FILE).exists():
            return np.empty(0, ROW_DTYPE)
        return np.concatenate([np.empty(0, ROW_DTYPE), *read_records(self.folder / RECORDS_FILE)])

    @cached_property
    def events(self) -> list[dict[str, Any]]:
        """Of events.jsonl."""
        lines = (self.folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines]

    @cached_property
    def wire(self) -> Wire:
        """Of its frames; none where it was cut off before its first cycle was known."""
        return read_wire(self.folder) if read_metadata(self.folder / RECORDS_FILE) else Wire()

    @cached_property
    def first_cycle(self) -> int:
        """On the clock of the bench, and so of the drives' witnesses, ns."""
        return int(read_metadata(self.folder / RECORDS_FILE)[FIRST_CYCLE])

    @property
    def planned(self) -> int:
        """Cycles of each axis."""
        return -(-round(self.config.bench.duration_s * NS_PER_S) // self.config.loop.period)


@dataclass(frozen=True)
class Member(Ran):
    """A run of the campaign: its recording or the memory of this process has it."""

    run: Run = field(kw_only=True)

    @property
    def whole(self) -> bool:
        """Nobody takes anything away from it."""
        return True

    @cached_property
    def rows(self) -> Rows:
        """(n,) of all axes."""
        return self.run.rows

    @property
    def events(self) -> list[dict[str, Any]]:
        """Of events.jsonl, if there is one."""
        return self.run.events

    @property
    def wire(self) -> Wire:
        """All frames."""
        return self.run.wire

    @property
    def first_cycle(self) -> int:
        """On the clock of the bench, and so of the drives' witnesses, ns."""
        return int(self.run.table.schema.metadata[FIRST_CYCLE.encode()])
