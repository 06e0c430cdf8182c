"""The cycles of an axis as one entity of Rerun: what each costs, and which line is which."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from servobench.hil.recording.telemetry import Telemetry
from servobench.hil.recording.wide_rows import field_of
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import Rows
from tests.rrd_columns import numbers
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records
from tests.unit.hil.test_summary import summary_with

CYCLES = 16_000


def written(folder: Path, rows: Rows, plan: RecordingPlan | None = None) -> Path:
    """A run as a live viewer is sent it: without envelopes."""
    folder.mkdir(exist_ok=True)
    plan = plan or plan_for(folder)
    telemetry = Telemetry(plan, "a-recording", rr.FileSink(folder / "run.rrd"), live=True)
    telemetry.take_rows(rows)
    telemetry.finish(summary_with(), Review(plan.review))
    return folder / "run.rrd"


def made(cycles: int) -> Rows:
    return rows_of(synthetic_records(cycles)).copy()


def test_a_cycle_takes_a_third_of_what_it_took(tmp_path: Path) -> None:
    """An entity for each line took 227 bytes a cycle of a run without faults; an hour has 3.6 million."""
    whole, none = written(tmp_path / "whole", made(CYCLES)), written(tmp_path / "none", made(1))
    assert (whole.stat().st_size - none.stat().st_size) / CYCLES < 75.0


def test_each_chunk_of_cycles_holds_all_lines_of_its_axis(tmp_path: Path) -> None:
    path = written(tmp_path, made(40))
    chunks = [chunk for chunk in RrdReader(path).stream() if str(chunk.entity_path) == "/axis1/cycles"]
    (chunk,) = chunks
    assert chunk.to_record_batch().num_rows == 40
    other = {str(each.entity_path) for each in RrdReader(path).stream()} - {"/axis1/cycles"}
    assert not {"/axis1/speed/measured", "/axis1/delay/delay", "/axis1/clock/offset"} & other


def test_signals_of_a_controller_may_be_called_as_they_like(tmp_path: Path) -> None:
    names = ("gap", "force [N]", "a_b", "a b", "é", "1.x")
    rows = made(30)
    for place in range(len(names)):
        rows[f"channel_{place}"] = 10.0 * place + np.arange(30)
    path = written(tmp_path, rows, replace(plan_for(tmp_path), channels={"axis1": names}))
    for place, name in enumerate(names):
        assert numbers(path, f"/axis1/controller/{name}")[1].tolist() == rows[f"channel_{place}"].tolist()
    assert len({field_of(f"controller/{name}") for name in names}) == len(names)


@pytest.mark.parametrize(("line", "exact"), [("position/measured", True), ("speed/measured", False)])
def test_positions_of_many_turns_keep_all_their_digits(tmp_path: Path, line: str, exact: bool) -> None:
    plan = plan_for(tmp_path)
    axis = replace(plan.review.axes[0], quantity="position")
    rows = made(30)
    told = 60_000.0 + 1e-4 * np.arange(30)
    rows["position_rad"] = told
    rows["velocity_rad_s"] = told * np.pi / 30.0
    path = written(tmp_path, rows, replace(plan, review=replace(plan.review, axes=(axis,))))
    error = np.abs(numbers(path, f"/axis1/{line}")[1] - told[rows["fate"] == 0]).max()
    assert bool(error < 1e-9) is exact
    assert error < 0.003
