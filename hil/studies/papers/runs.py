"""Cases 1 to 3 of [Ling2012] on the simulated bench: real sampling, delay and loss through the bus.

A sample takes 4 ms to the host; five of every six set-points are lost on the way to the drive. As the
feedback is static, a lost set-point is to the loop what a lost sample is, [Ling2012] (2.11), but
all readings come, so that the recording shows what the motor really does. The drive's current loops
are as slow as the paper's, R/L. Samples act at SYNCs where they are postponed, so the agreed 64 ms become 70,
the first SYNC at which a sample is as old. The strategy history needs packets that carry six samples, which a
PDO of eight bytes cannot; without loss, stamp is the same thing, and runs in its place.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.papers.ling2012 import LOAD_ON_S, SPEED_RAD_S
from drivers.timebase import NS_PER_S
from hil.configuration.bench_file import load_bench
from hil.execution.bench import run_bench
from hil.machine.examples import examples_folder
from hil.machine.stopping import Interrupted
from hil.rows.records_file import RECORDS_FILE, read_records
from hil.verdict.verdict import VerdictKind

VARIANTS = (
    ("case1", "stamp"),
    ("case1", "arrival"),
    ("case2", "pi_careful"),
    ("case2", "pi_eager"),
    ("case3", "stamp"),
    ("case3", "arrival"),
    ("case3", "history"),
)
"""Case, and what is done with samples, or which PI: each a bench of examples/ling2012_cases."""
LOAD_AT_S = 3.0
"""Of Case 3, when the start is over; 0.5 s in the paper, where it is not (Case 1)."""
_BANDS = (0.05, 0.02)
_END_S = 0.2
"""So long, at its end, a run must stay within 5 % to count as settled."""


@dataclass(frozen=True, slots=True, eq=False)
class PaperRun:
    """A recorded run: instants, (n,) s, and speed error there, rad/s."""

    case: str
    variant: str
    time_s: NDArray[np.float64]
    error_rad_s: NDArray[np.float64]
    figures: dict[str, Any]


def run_cases(folder: Path, tell: Callable[[str], None]) -> list[PaperRun]:
    """Every variant, each recorded in a folder of its own below ``folder``."""
    return [_run(case, name, folder, tell) for case, name in VARIANTS]


def bench_of(case: str, name: str) -> Path:
    """The bench file of a variant."""
    return examples_folder() / "ling2012_cases" / f"{case}-{name.replace('_', '-')}.toml"


def _run(case: str, name: str, folder: Path, tell: Callable[[str], None]) -> PaperRun:
    config = load_bench(bench_of(case, name))
    tell(f"{case}, {name}: on the simulated bench")
    record = folder / config.bench.name
    summary = run_bench(config, record=record)
    if ended_by := summary.verdict.of(VerdictKind.INTERRUPTED):
        raise Interrupted("; ".join(ended_by))
    time_s, error = _errors(record)
    figures = _figures(time_s, error, loaded=case == "case3") | {
        "delay_p99_us": summary.delay_us.p99,
        "recording": str(record),
    }
    return PaperRun(case, name, time_s, error, figures)


def _errors(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rows = np.concatenate(list(read_records(folder / RECORDS_FILE)))
    came = np.isfinite(rows["velocity_rad_s"])
    time_s = (rows["sampled_at"] - rows["due_at"][0]) / NS_PER_S
    return time_s[came], (rows["reference_rad_s"] - rows["velocity_rad_s"])[came]


def _figures(
    time_s: NDArray[np.float64], error: NDArray[np.float64], *, loaded: bool
) -> dict[str, float | bool | None]:
    share = error / SPEED_RAD_S
    if not loaded:
        return {
            "settled": bool(np.abs(share[time_s > time_s[-1] - _END_S]).max() < _BANDS[0]),
            "overshoot_percent": 100.0 * max(0.0, -float(share.min())),
            **_settling(time_s, share, "settling"),
        }
    under = time_s >= LOAD_AT_S
    gone_s = LOAD_AT_S + LOAD_ON_S
    after = time_s >= gone_s
    return {
        "peak_rad_s": float(np.abs(error[under]).max()),
        "peak_percent": 100.0 * float(np.abs(share[under]).max()),
        "swing_back_percent": 100.0 * max(0.0, -float(share[under].min())),
        **_settling(time_s[after] - gone_s, share[after], "recovery"),
    }


def _settling(time_s: NDArray[np.float64], share: NDArray[np.float64], name: str) -> dict[str, float | None]:
    """When |share| stays within each band from then on; None if it is outside at the end."""
    times_s: dict[str, float | None] = {}
    for band in _BANDS:
        outside = np.flatnonzero(np.abs(share) > band)
        first = outside[-1] + 1 if len(outside) else 0
        times_s[f"{name}_{100 * band:g}_percent_s"] = None if first == len(share) else float(time_s[first])
    return times_s
