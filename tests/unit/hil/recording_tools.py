"""A recording plan, and how a run ended, for tests."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from servobench.hil.rows.recording_plan import AxisPlan, RecordingPlan, ReviewPlan
from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.verdict import DriveEnd, RunOutcome
from tests.unit.hil.synthetic_run import DEADLINE

RESTING = DriveEnd("axis1", "operation enabled", "switch on disabled", at_rest=True)


def whole_outcome(cycles: int) -> RunOutcome:
    """Of a run of one axis with nothing to complain of."""
    return RunOutcome(53.0, 40.0, cycles_planned=cycles, drives=(RESTING,))


def plan_for(folder: Path, real_time: bool = False) -> RecordingPlan:
    """One axis on the simulated bus, recorded into ``folder``."""
    return RecordingPlan(
        folder=folder,
        name="synthetic",
        seed=2012,
        bus="simulated",
        real_time=real_time,
        deadline=DEADLINE,
        review=ReviewPlan((AxisPlan("axis1", 6_250.0),), VerdictLimits(dropouts_percent_max=10.0)),
        bench_toml="# resolved\n",
    )


@contextmanager
def files_below(size: int) -> Iterator[None]:
    """No file may grow beyond ``size``, bytes; as if the disk were full there."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
