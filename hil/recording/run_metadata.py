"""Metadata of a run, in records.arrow and run.rrd, and its summary, for which room on the disk is kept."""

import fcntl
import json
import os
import platform
import re
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from servobench.drivers.bounded_file import parse_json, read_text
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Instant
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.run_files import (
    BENCH_START,
    FIRST_CYCLE,
    FIRST_CYCLE_EPOCH,
    FORMAT,
    RESERVE_FILE,
    SUMMARY_FILE,
)
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary

_ROOT = Path(__file__).parents[2]
_GIT_MAX_S = 5.0


def run_metadata(plan: RecordingPlan, zero: Instant, drives: Mapping[str, str]) -> dict[str, str]:
    """Names and texts, those of several parts as JSON.

    ``zero``: the first cycle on the bench clock. ``drives``: by axis, who its drive says it is.
    """
    return {
        "format": FORMAT,
        "bench": plan.name,
        "seed": str(plan.seed),
        "bus": plan.bus,
        "axes": json.dumps([axis.name for axis in plan.review.axes]),
        "drives": json.dumps(dict(drives)),
        "channels": json.dumps(plan.channels),
        "own_code": plan.sources,
        "time": "simulated" if plan.wall_offset is None else "real",
        FIRST_CYCLE_EPOCH: str(zero + plan.stamp_offset(zero)),
        FIRST_CYCLE: str(zero),
        BENCH_START: str(plan.started_at - zero),
        "host": json.dumps(_host()),
        "servobench": _version(),
        "commit": source_commit(),
    }


def _host() -> dict[str, str]:
    system = platform.uname()
    return {
        "name": system.node,
        "system": f"{system.system} {system.release}",
        "machine": system.machine,
        "processors": str(os.cpu_count()),
        "python": platform.python_version(),
    }


def _version() -> str:
    try:
        return version("servobench")
    except PackageNotFoundError:
        return ""


@cache
def source_commit() -> str:
    """Return the commit of the running source tree, with "-dirty" if it was changed since; empty outside
    git."""
    if not (_ROOT / ".git").exists():
        return ""
    # status without its optional lock: a git that is killed in between must leave none in the user's tree
    command = ["git", "--no-optional-locks", "-C", str(_ROOT), "status", "--porcelain=v2", "--branch"]
    try:
        git = subprocess.run(
            [*command, "--untracked-files=no"],
            capture_output=True, text=True, timeout=_GIT_MAX_S, check=False, stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return ""
    commit = re.search(r"^# branch[.]oid ([0-9a-f]{40})$", git.stdout, re.MULTILINE)
    changed = re.search(r"^[^#]", git.stdout, re.MULTILINE)
    return "" if commit is None else commit[1] + ("-dirty" if changed else "")


_RESERVE_BYTES = 256 * 1024
"""Given back at the end: network.toml has 5 kB, fault.txt 30, the end of records.arrow 86 for each hour."""
_SUMMARY_BYTES = 32 * 1024
"""summary.json has 3 kB, and a kilobyte for each step of a load machine."""
_WHOLE = "a whole summary"
_FORMERLY: Final = {"delay_us": "reading_delay_us", "losses_in_a_row": "reading_losses_in_a_row"}
"""Keys of older recordings that have another name now."""


class Reserve:
    """Room on the disk that the recording itself cannot fill. Who holds it is the one who records."""

    def __init__(self, folder: Path) -> None:
        """Error: OSError if there is no such room; BlockingIOError if somebody records into the folder."""
        self._path = folder / RESERVE_FILE
        self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.posix_fallocate(self._descriptor, 0, _RESERVE_BYTES)
        except BlockingIOError:
            os.close(self._descriptor)
            raise
        except OSError:
            self.close()
            raise

    def release(self) -> None:
        """The room is there for the end of the other files now; what the summary needs stays kept."""
        os.ftruncate(self._descriptor, _SUMMARY_BYTES)

    def close(self) -> None:
        """Nobody records here any more, or all but the summary is written."""
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)


def write_summary(folder: Path, summary: Summary) -> None:
    """summary.json, which is either there as a whole or not at all. Error: OSError."""
    text = json.dumps(summary.as_json(), indent=2) + "\n"
    part = folder / f"{SUMMARY_FILE}.part"
    try:
        part.write_text(text)
        part.replace(folder / SUMMARY_FILE)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def read_summary(folder: Path) -> Summary:
    """Read the summary of the run in ``folder``. Raises BadInput, and of it NoSuchFile."""
    path = folder / SUMMARY_FILE
    plain = parse_json(read_text(path, "summary"), str(path), _WHOLE)
    if isinstance(plain, dict):
        plain = {_FORMERLY.get(key, key): value for key, value in plain.items()}
    try:
        return from_plain(Summary, plain)
    except ValueError as error:
        raise BadInput(str(path), "", str(error), _WHOLE) from None
