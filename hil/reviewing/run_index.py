"""The recordings below a folder: when, which bench, which drives, which verdict, and which are not whole."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from servobench.drivers.bounded_file import parse_json, read_text, read_toml
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.written_file import is_locked
from servobench.hil.rows.arrow_file import is_whole
from servobench.hil.rows.records_file import read_metadata, refuse_later_format
from servobench.hil.rows.run_files import (
    BENCH_FILE,
    EVENTS_FILE,
    FIRST_CYCLE_EPOCH,
    RECORDS_FILE,
    RESERVE_FILE,
    SUMMARY_FILE,
)
from servobench.hil.rows.seal import NOT_CHECKED, SEALED, seal_of
from servobench.hil.verdict.verdict import VerdictKind

_DEPTH_MAX: Final = 6
"""Folders below the one that is asked for; runs lie in one, or in one for each day or bench."""
_VERDICTS: Final = frozenset(kind.value for kind in VerdictKind)
"""One of them is asked for as a whole: "passed" is not "passed, disturbed"."""


class RunState(StrEnum):
    """State of a recording."""

    WHOLE = "whole"
    RECORDING = "being recorded"
    NO_SUMMARY = "no summary"
    DAMAGED = "damaged"
    LATER_FORMAT = "later format"


@dataclass(frozen=True, slots=True)
class ListedRun:
    """One recording, as far as its files tell; empty for what they do not."""

    path: str
    at: datetime
    """The first cycle; in simulated time, or without a cycle, when its bench file was written."""
    state: RunState
    bench: str = ""
    drives: tuple[str, ...] = ()
    controllers: tuple[str, ...] = ()
    """Kind, or class of one's own, by axis."""
    verdict: str = ""
    """Outcome in summary.json, a value of VerdictKind; empty for a run that is damaged."""
    reason: str = ""
    """Reason for the verdict."""
    cycles: int | None = None
    commit: str = ""
    servobench: str = ""
    bus: str = ""
    note: str = ""
    """Defect of the recording, and the cure."""
    seal: str = ""
    """Result of checking the files against the seal; empty for a run that is not whole."""

    def as_json(self) -> dict[str, Any]:
        """Plain values; ``at`` as ISO 8601."""
        return {**asdict(self), "at": self.at.isoformat(), "state": self.state.value}


@dataclass(frozen=True, slots=True)
class RunFilter:
    """Which recordings are wanted: a part of the text that the run has, case apart; empty: any."""

    bench: str = ""
    drive: str = ""
    controller: str = ""
    verdict: str = ""
    """Verdict, or the state of a run that has none."""
    commit: str = ""
    """How it begins."""
    since: datetime | None = None

    def wants(self, run: ListedRun) -> bool:
        """All that is asked for holds."""
        verdict = (run.verdict or run.state.value).lower()
        asked = self.verdict.lower()
        return (
            (self.since is None or run.at >= self.since)
            and self.bench.lower() in run.bench.lower()
            and any(self.drive.lower() in one.lower() for one in run.drives or ("",))
            and any(self.controller.lower() in one.lower() for one in run.controllers or ("",))
            and (verdict == asked if asked in _VERDICTS else verdict.startswith(asked))
            and run.commit.startswith(self.commit)
        )


def list_runs(folder: Path, wanted: RunFilter | None = None, *, unsealed: bool = False) -> list[ListedRun]:
    """The recordings in and below ``folder``, in order of time; ``unsealed``: whether or not their files are
    as they were recorded. Raises BadInput if it is none."""
    if not folder.is_dir():
        raise BadInput("DIR", "", str(folder), "a folder")
    chosen = wanted or RunFilter()
    listed = [run for run in (_listed(each, unsealed) for each in _run_folders(folder)) if chosen.wants(run)]
    return sorted(listed, key=lambda run: (run.at, run.path))


def _run_folders(folder: Path) -> Iterator[Path]:
    """A bench file beside what a run leaves; nothing below a recording is looked at."""
    depth = len(folder.parts)
    for here, below, files in os.walk(folder):
        if BENCH_FILE in files and not {RECORDS_FILE, EVENTS_FILE, SUMMARY_FILE}.isdisjoint(files):
            below.clear()
            yield Path(here)
        elif len(Path(here).parts) - depth >= _DEPTH_MAX:
            below.clear()
        below.sort()


def _listed(folder: Path, unsealed: bool) -> ListedRun:
    path = folder / SUMMARY_FILE
    metadata = _table(lambda: read_metadata(folder / RECORDS_FILE))
    # raw: the bench of an earlier version need not be one of today's
    told = _table(lambda: read_toml(folder / BENCH_FILE, "bench file"))
    summary = _table(lambda: parse_json(read_text(path, "summary"), str(path), "a summary"))
    state, note = _state(folder, metadata, summary)
    seal = ""
    if state is RunState.WHOLE:
        try:
            seal = seal_of(folder, unsealed=unsealed)
            note = note or ("" if seal in (SEALED, NOT_CHECKED) else seal)
        except (BadInput, OSError) as error:
            state, note = RunState.DAMAGED, str(error)
    if state is RunState.DAMAGED:
        summary = {}  # of which nothing can be believed
    verdict, bench = _table(lambda: summary.get("verdict")), _table(lambda: told.get("bench"))
    drives = _table(lambda: json.loads(metadata.get("drives", "{}")))
    cycles = summary.get("cycles")
    return ListedRun(
        path=str(folder),
        at=_at(folder, metadata),
        state=state,
        bench=metadata.get("bench") or str(bench.get("name", "")),
        drives=tuple(str(drive) for drive in drives.values()),
        controllers=tuple(_controller(drive) for drive in _table(lambda: told.get("drive")).values()),
        verdict=str(verdict.get("outcome", "")),
        reason=str(verdict.get("reason", "")),
        cycles=cycles if isinstance(cycles, int) else None,
        commit=metadata.get("commit", ""),
        servobench=metadata.get("servobench", ""),
        bus=metadata.get("bus", ""),
        note=note,
        seal=seal,
    )


def _state(folder: Path, metadata: Mapping[str, str], summary: Mapping[str, Any]) -> tuple[RunState, str]:
    """``summary``: empty if there is none, or no whole one."""
    records = folder / RECORDS_FILE
    try:
        refuse_later_format(metadata, records)
    except BadInput as error:
        return RunState.LATER_FORMAT, f"format {metadata['format']}: expected {error.expected}"
    if not summary:
        if is_locked(folder / RESERVE_FILE):  # by who records, servobench.hil.recording.run_metadata
            return RunState.RECORDING, ""
        return RunState.NO_SUMMARY, f"its recorder did not live to its end: hil recover {folder}"
    if not records.is_file():
        return RunState.DAMAGED, f"{RECORDS_FILE} is missing"
    if not is_whole(records):
        return RunState.DAMAGED, f"{RECORDS_FILE} has no end, though there is a summary"
    lacks = summary.get("recording_faults") or []
    return RunState.WHOLE, "; ".join(map(str, lacks)) if isinstance(lacks, list) else ""


def _at(folder: Path, metadata: Mapping[str, str]) -> datetime:
    epoch = metadata.get(FIRST_CYCLE_EPOCH, "")
    if metadata.get("time") == "real" and epoch.isdecimal():
        return datetime.fromtimestamp(int(epoch) / NS_PER_S, UTC)
    return datetime.fromtimestamp((folder / BENCH_FILE).stat().st_mtime, UTC)


def _table(told: Callable[[], Any]) -> dict[str, Any]:
    """Return the result if it is a table, else an empty one: files may be damaged, or those of another
    version."""
    try:
        table = told()
    except (BadInput, OSError, ValueError):
        return {}
    return table if isinstance(table, dict) else {}


def _controller(drive: Any) -> str:
    controller = _table(lambda: drive).get("controller")
    if not isinstance(controller, dict):
        return str(controller or "")
    kind = str(controller.get("kind", ""))
    return f"{kind} {controller['object']}" if "object" in controller else kind
