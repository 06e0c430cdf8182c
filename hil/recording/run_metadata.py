"""Metadata of a run, stored in records.arrow and as properties of run.rrd."""

import json
import os
import platform
import re
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from servobench.drivers.timebase import Instant
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.run_files import BENCH_START, FIRST_CYCLE, FIRST_CYCLE_EPOCH, FORMAT

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
