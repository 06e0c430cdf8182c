"""``hil compare``: against brute force over the rows of both runs, and as a gate."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from typer.testing import CliRunner

from servobench.drivers.timebase import Instant
from servobench.hil.cli import app
from servobench.hil.recorded.comparison import compare_runs
from servobench.hil.recorded.recorded_run import open_run
from servobench.hil.recording.sealer import Sealer
from servobench.hil.rows.records import Rows
from servobench.hil.rows.records_file import RecordsWriter, read_metadata, read_records
from tests.draws import few_of
from tests.unit.hil.recorded_runs import short_run

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("forked_children")]

SEED_OF_THE_OTHER = 5


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same bench with two seeds."""
    folder = tmp_path_factory.mktemp("runs")
    return short_run(folder / "one"), short_run(folder / "other", seed=SEED_OF_THE_OTHER)


def compare(*arguments: object) -> tuple[int, str]:
    found = CliRunner().invoke(app, ["compare", *map(str, arguments)])
    return found.exit_code, found.stdout


def rows_of(folder: Path) -> Rows:
    return np.concatenate(list(read_records(folder / "records.arrow")))


def with_rows(run: Path, copy: Path, rows: Rows, batch: int) -> Path:
    """A copy of a run's folder with other rows, in batches of so many."""
    shutil.copytree(run, copy)
    writer = RecordsWriter(copy / "records.arrow")
    writer.begin(read_metadata(run / "records.arrow"), Instant(0))
    for start in range(0, rows.size, batch):
        writer.write(rows[start : start + batch])
    writer.close()
    Sealer(copy).finish()
    return copy


def test_differences_are_those_of_the_rows(runs: tuple[Path, Path]) -> None:
    one, other = map(rows_of, runs)
    both = (one["fate"] == 0) & (other["fate"] == 0)
    apart = np.abs(other["velocity_rad_s"] - one["velocity_rad_s"])[both]
    status, told = compare(*runs, "--json")
    found = json.loads(told)["runs"][1]["differences"]["axis1"]["velocity_rad_s"]
    assert status == 0
    assert found["rms"] == pytest.approx(float(np.sqrt(np.mean(apart**2))))
    assert found["max"] == apart.max()
    assert found["at_ns"] == one["due_at"][both][apart.argmax()]


def test_the_same_run_nowhere_differs(runs: tuple[Path, Path]) -> None:
    status, told = compare(runs[0], runs[0])
    assert status == 0
    assert "every cycle of both is the same" in told


@pytest.mark.parametrize("batch", few_of([17, 1_000, 1, 100], 2))
def test_the_first_divergence_is_found_however_the_rows_are_divided(
    runs: tuple[Path, Path], tmp_path: Path, batch: int
) -> None:
    rows = rows_of(runs[0])
    rows["reference_rad_s"][123] += 1e-12 + rows["reference_rad_s"][123] * 1e-9
    rows["command_torque_nm"][200:] += 0.5
    changed = with_rows(runs[0], tmp_path / "changed", rows, batch)
    for pair in ((runs[0], changed), (changed, runs[0])):
        divergence = compare_runs([open_run(folder) for folder in pair])[1].divergence
        assert divergence is not None
        assert (divergence.cycle, divergence.at_ns) == (124, rows["due_at"][123])
        assert divergence.columns == ("reference_rad_s",)


def test_runs_of_unlike_length_are_compared_as_far_as_both_go(
    runs: tuple[Path, Path], tmp_path: Path
) -> None:
    short = with_rows(runs[0], tmp_path / "short", rows_of(runs[0])[:150], 40)
    for pair in ((runs[0], short), (short, runs[0])):
        found = compare_runs([open_run(folder) for folder in pair])[1]
        assert found.cycles_of_both == 150
        assert found.divergence is None


@pytest.mark.parametrize(
    ("tolerance", "status"),
    [
        ("speed_difference_max_rad_s = 1000.0", 0),
        ("speed_difference_max_rad_s = 0.0", 1),
        ("recovery_time_ms = 1.0", 0),
        ("no_figure = 1.0", 2),
    ],
)
def test_a_gate_for_ci(runs: tuple[Path, Path], tmp_path: Path, tolerance: str, status: int) -> None:
    file = tmp_path / "tolerances.toml"
    file.write_text(tolerance + "\n")
    assert compare(runs[1], "--baseline", runs[0], "--tolerances", file)[0] == status


def test_one_run_alone_is_nothing_to_compare(runs: tuple[Path, Path]) -> None:
    assert compare(runs[0])[0] == 2


def test_the_recording_holds_both_runs(runs: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "both.rrd"
    compare(*runs, "--rrd", out)
    paths = {str(chunk.entity_path) for chunk in RrdReader(out).stream()}
    assert {"/0_one/axis1/speed/measured", "/1_other/axis1/speed/measured", "/differences"} <= paths


def test_a_place_that_takes_no_recording_is_named_by_its_option(
    runs: tuple[Path, Path], tmp_path: Path
) -> None:
    out = tmp_path / "both.rrd"
    out.mkdir()
    found = CliRunner().invoke(app, ["compare", *map(str, runs), "--rrd", str(out)])
    assert found.exit_code == 2
    assert "hil: error: --rrd" in found.stderr
