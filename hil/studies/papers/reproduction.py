"""[Ling2012] for ``hil reproduce ling2012``: Table 2, the printed design, and Cases 1 to 3.

The cases run on the simulated bench, with real sampling, delay and loss through the bus. A sample takes 4 ms
to the host; five of every six set-points are lost on the way to the drive. As the feedback is static, a lost
set-point is to the loop what a lost sample is, [Ling2012] (2.11), but all readings come, so that the
recording shows what the motor really does. The drive's current loops are as slow as the paper's, R/L. Samples
act at SYNCs where they are postponed, so the agreed 64 ms become 70, the first SYNC at which a sample is as
old. The strategy history needs packets that carry six samples, which a PDO of eight bytes cannot; without
loss, stamp is the same thing, and runs in its place.
"""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servobench.design.delay.delay_loop import Units
from servobench.design.motor import PmsmParameters
from servobench.design.papers.ling2012 import (
    BANDS,
    DELAY_S,
    LOAD_NM,
    LOAD_ON_S,
    LOSSES,
    MOTOR,
    PERIOD_S,
    SPEED_RAD_S,
    TABLE_2,
    TAU_S,
    case1,
    case2,
    case3,
    motor_row,
    published_design,
    table2_row,
)
from servobench.design.papers.ling2012 import (
    K as PUBLISHED_GAIN,
)
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.execution.bench import run_bench
from servobench.hil.machine.extras import examples_folder
from servobench.hil.machine.stopping import Interrupted
from servobench.hil.rows.records_file import read_records
from servobench.hil.rows.run_files import RECORDS_FILE
from servobench.hil.studies.speed.analysis import LoopRequest, sampled_figures
from servobench.hil.verdict.verdict import VerdictKind

VARIANTS = (
    ("case1", "stamp"),
    ("case1", "arrival"),
    ("case2", "pi_careful"),
    ("case2", "pi_eager"),
    ("case3", "stamp"),
    ("case3", "arrival"),
    ("case3", "history"),
)
"""Case, and use of samples, or the PI: each a bench of examples/ling2012_cases."""
LOAD_AT_S = 3.0
"""Instant of Case 3's load, after the start; 0.5 s in the paper, where the start is not over (Case 1)."""
_END_S = 0.2
"""At its end a run must stay within 5 % for this time to count as settled."""
_PROCESSES = 2


@dataclass(frozen=True, slots=True, eq=False)
class PaperRun:
    """A recorded run: instants, (n,) s, and speed error there, rad/s."""

    case: str
    variant: str
    time_s: NDArray[np.float64]
    error_rad_s: NDArray[np.float64]
    figures: dict[str, Any]


def reproduce(runs: Path, tell: Callable[[str], None]) -> tuple[dict[str, Any], list[PaperRun]]:
    """Return the figures, and the recorded runs, which go into folders below ``runs``."""
    tell("Table 2: 11 rows by 4 methods in 2 conventions of units")
    figures: dict[str, Any] = {"table2": table2(), "published_design": published_design()}
    tell("the three strategies: certificates for every sequence")
    figures["strategies"] = strategies()
    recorded = [_run(case, name, runs, tell) for case, name in VARIANTS]
    cases: dict[str, Callable[[], dict[str, Any]]] = {"case1": case1, "case2": case2, "case3": case3}
    for name, case in cases.items():
        figures[name] = case() | {"bench": {run.variant: run.figures for run in recorded if run.case == name}}
    return figures, recorded


def for_motor(motor: PmsmParameters) -> dict[str, Any]:
    """Return Table 2 for another motor: the largest delay for each error of the paper, at its own rating."""
    errors = [error for error, _ in TABLE_2]
    with _pool() as pool:
        rows = list(pool.map(motor_row, [motor] * len(errors), errors))
    share = LOAD_NM / MOTOR.rated_torque_nm
    return {
        "motor": motor.name,
        "load_nm": share * motor.rated_torque_nm,
        "speed_rpm": motor.rated_speed_rad_s / RAD_S_PER_RPM,
        "rows": rows,
    }


def table2() -> dict[str, list[dict[str, Any]]]:
    """Return every row in both conventions, on two processes."""
    asked = [(error, delay_s, units) for units in (Units.PUBLISHED, Units.SI) for error, delay_s in TABLE_2]
    with _pool() as pool:
        rows = list(pool.map(table2_row, *zip(*asked, strict=True)))
    half = len(TABLE_2)
    return {"published": rows[:half], "si": rows[half:]}


def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(_PROCESSES, mp_context=get_context("spawn"))


def strategies() -> dict[str, dict[str, Any]]:
    """Return the figures of the printed gain in the sampled loop of Case 3, by strategy."""
    request = LoopRequest(MOTOR, PUBLISHED_GAIN, DELAY_S, None, LOAD_NM, SPEED_RAD_S)
    agreed_s = {Strategy.ARRIVAL: 0.0, Strategy.STAMP: DELAY_S, Strategy.HISTORY: DELAY_S}
    return {
        strategy.value: sampled_figures(
            request, SampledNetwork(strategy, PERIOD_S, LOSSES, TAU_S, agreed_s[strategy])
        )
        for strategy in Strategy
    }


def bench_of(case: str, name: str) -> Path:
    """Return the bench file of a variant."""
    return examples_folder() / "ling2012_cases" / f"{case}-{name.replace('_', '-')}.toml"


def _run(case: str, name: str, folder: Path, tell: Callable[[str], None]) -> PaperRun:
    """Run a variant, recorded in its own folder below ``folder``."""
    config = load_bench(bench_of(case, name))
    tell(f"{case}, {name}: on the simulated bench")
    record = folder / config.bench.name
    summary = run_bench(config, record=record)
    if ended_by := summary.verdict.of(VerdictKind.INTERRUPTED):
        raise Interrupted("; ".join(ended_by))
    time_s, error = _errors(record)
    figures = _figures(time_s, error, loaded=case == "case3") | {
        "delay_p99_us": summary.reading_delay_us.p99,
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
            "settled": bool(np.abs(share[time_s > time_s[-1] - _END_S]).max() < BANDS[0]),
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
    """Return when |share| finally stays within each band; None if it is outside at the end."""
    times_s: dict[str, float | None] = {}
    for band in BANDS:
        outside = np.flatnonzero(np.abs(share) > band)
        first = outside[-1] + 1 if len(outside) else 0
        times_s[f"{name}_{100 * band:g}_percent_s"] = None if first == len(share) else float(time_s[first])
    return times_s
