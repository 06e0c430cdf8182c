"""A recording plan for tests."""

from pathlib import Path

from hil.figures.summary import VerdictLimits
from hil.recording.recording_plan import AxisPlan, RecordingPlan, ReviewPlan
from tests.unit.hil.synthetic_run import DEADLINE


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
