"""A recording in other formats, read back by readers of their own: the same numbers, nulls and units."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from scipy.io import loadmat
from typer.testing import CliRunner, Result

from servobench.drivers.timebase import Instant
from servobench.hil.cli import app
from servobench.hil.loop.cycle_record import COLUMNS
from servobench.hil.reviewing.export import CHUNK_ROWS, RecordedRows
from servobench.hil.rows.records import ROW_DTYPE
from servobench.hil.rows.records_file import RecordsWriter, read_table
from servobench.hil.rows.run_files import RECORDS_FILE
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records

pytestmark = pytest.mark.usefixtures("forked_children")

pd: Any = pytest.importorskip("pandas")

ZERO = Instant(7_000_000_000)
AXES = ["left", "right"]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Two axes of 400 cycles, one batch each 100."""
    folder = tmp_path / "run"
    folder.mkdir()
    writer = RecordsWriter(folder / RECORDS_FILE)
    writer.begin({"format": "3", "axes": json.dumps(AXES), "bench": "two"}, ZERO)
    rows = np.empty(800, ROW_DTYPE)
    for axis in range(2):
        rows[axis::2] = rows_of(synthetic_records(400, seed=axis, origin=ZERO, axis=axis))
    for batch in np.array_split(rows, 8):
        writer.write(batch)
    writer.close()
    return folder


def export(run: Path, *arguments: str) -> Result:
    return CliRunner().invoke(app, ["export", str(run), *arguments])


def table_of(run: Path) -> pa.Table:
    return read_table(run / RECORDS_FILE)


def column(table: pa.Table, name: str) -> Any:
    """By pandas, with NaN for null."""
    return table[name].to_pandas()


def test_parquet_has_all_that_records_arrow_has(run: Path) -> None:
    assert export(run, "--to", "parquet").exit_code == 0
    again = pyarrow.parquet.read_table(run / "records.parquet")
    assert again.equals(table_of(run), check_metadata=True)
    assert again.schema.field("due_at").metadata[b"unit"] == b"ns since the first cycle"
    assert json.loads(again.schema.metadata[b"axes"]) == AXES


def test_csv_read_by_pandas(run: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    done = export(run, "--to", "csv", "--out", str(path), "--json")
    assert (done.exit_code, json.loads(done.stdout)["rows"]) == (0, 800)
    again, table = pd.read_csv(path), table_of(run)
    assert len(again) == 800
    assert {"due_at_ns", "velocity_rad_s", "delay_ns", "command_torque_nm"} < set(again.columns)
    assert again["axis"].tolist() == [AXES[number] for number in table["axis"].to_pylist()]
    codes = json.loads(table.schema.field("fate").metadata[b"codes"])
    assert again["fate"].tolist() == [codes[str(number)] for number in table["fate"].to_pylist()]
    assert set(again["phase"]) == {"run"}
    for name, title in (
        ("due_at", "due_at_ns"),
        ("delay_ns", "delay_ns"),
        ("velocity_rad_s", "velocity_rad_s"),
    ):
        np.testing.assert_array_equal(again[title].astype(float), column(table, name).astype(float))
    assert again["delay_ns"].isna().any()


def test_mat_read_by_scipy(run: Path) -> None:
    assert export(run, "--to", "mat").exit_code == 0
    again: Any = loadmat(run / "records.mat", squeeze_me=True, struct_as_record=False)
    table = table_of(run)
    for each in COLUMNS:
        expected = column(table, each.name).astype(float)
        np.testing.assert_array_equal(again[each.name].astype(float), expected, err_msg=each.name)
    assert again["sequence"].dtype == np.int64
    assert again["delay_ns"].dtype == np.float64
    assert again["units"].velocity_rad_s == "rad/s"
    assert list(again["codes"].axis) == AXES
    assert again["codes"].fate[1] == "lost"
    assert again["run"].bench == "two"
    assert loadmat(run / "records.mat")["due_at"].shape == (800, 1)


def test_mat_keeps_integers_that_float64_cannot_hold(run: Path) -> None:
    """One column, with and without nulls, beyond 2^53: to the last digit, and the least integer for null."""
    table = table_of(run)
    place = table.schema.get_field_index("device_time_ns")
    values = pa.array([None, *((1 << 60) + number for number in range(799))], pa.int64())
    changed = table.set_column(place, table.schema.field(place), values)
    with pa.ipc.new_file(run / RECORDS_FILE, changed.schema) as sink:
        sink.write_table(changed, max_chunksize=100)
    assert export(run, "--to", "mat").exit_code == 0
    again = loadmat(run / "records.mat", squeeze_me=True)["device_time_ns"]
    assert again.tolist() == [-(1 << 63), *((1 << 60) + number for number in range(799))]


def test_mf4_read_by_asammdf(run: Path) -> None:
    asammdf: Any = pytest.importorskip("asammdf")
    done = export(run, "--to", "mf4", "--json")
    assert json.loads(done.stdout)["rows"] == 800
    table = table_of(run).to_pandas()
    with asammdf.MDF(run / "records.mf4") as again:
        for number, axis in enumerate(AXES):
            mine = table[table["axis"] == number]
            for name in ("velocity_rad_s", "delay_ns", "fate", "command_raw", "certain", "sampled_at"):
                signal = again.get(f"{axis}.{name}", ignore_invalidation_bits=True, raw=True)
                invalid = signal.invalidation_bits
                gone = np.zeros(len(mine), bool) if invalid is None else np.asarray(invalid, bool)
                np.testing.assert_array_equal(gone, mine[name].isna(), err_msg=name)
                np.testing.assert_array_equal(
                    signal.samples[~gone].astype(float),
                    mine[name].to_numpy()[~gone].astype(float),
                    err_msg=name,
                )
                np.testing.assert_array_equal(signal.timestamps, mine["due_at"] / 1e9)
            words = dict(enumerate(("sample", "lost", "late", "stale", "missed")))
            fates = again.get(f"{axis}.fate").samples.tolist()
            assert [fate.decode() for fate in fates] == [words[code] for code in mine["fate"]]
            assert {phase.decode() for phase in again.get(f"{axis}.phase").samples.tolist()} == {"run"}
        assert again.get("left.velocity_rad_s").unit == "rad/s"
        assert "bench: two" in again.header.comment


def test_without_asammdf_mf4_is_refused_with_the_command_that_mends_it(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "asammdf", None)
    result = export(run, "--to", "mf4")
    assert (result.exit_code, "pip install 'servobench[mf4]'" in result.stderr) == (2, True)
    assert sorted(path.name for path in run.iterdir()) == [RECORDS_FILE]


@pytest.mark.long
def test_the_memory_that_is_held_is_bounded(run: Path) -> None:
    """Batches are joined up to CHUNK_ROWS, however many there are."""
    table = table_of(run)
    with pa.ipc.new_file(run / RECORDS_FILE, table.schema) as sink:
        for _ in range(CHUNK_ROWS // 800 + 10):
            sink.write_table(table)
    sizes = [chunk.num_rows for chunk in RecordedRows(run).chunks(["due_at"])]
    assert len(sizes) == 2
    assert max(sizes) < CHUNK_ROWS + 800
    assert sum(sizes) == 800 * (CHUNK_ROWS // 800 + 10)


def test_an_earlier_format_is_written_with_the_columns_that_it_has(run: Path) -> None:
    new = {"compute_ns", *(f"channel_{number}" for number in range(8))}
    table = table_of(run)
    old = table.drop_columns(sorted(new)).replace_schema_metadata({"format": "1", "axes": json.dumps(AXES)})
    with pa.ipc.new_file(run / RECORDS_FILE, old.schema) as sink:
        sink.write_table(old)
    for ending in ("parquet", "csv", "mat"):
        assert export(run, "--to", ending).exit_code == 0
    assert pyarrow.parquet.read_table(run / "records.parquet").equals(old, check_metadata=True)
    assert len(pd.read_csv(run / "records.csv").columns) == len(COLUMNS) + 1 - len(new)


def test_what_cannot_be_exported_is_refused(run: Path, tmp_path: Path) -> None:
    whole = (run / RECORDS_FILE).read_bytes()

    def refused(*arguments: str) -> str:
        result = export(run, "--to", "csv", *arguments)
        assert result.exit_code == 2, result.output
        return result.stderr

    (run / RECORDS_FILE).write_bytes(whole[:-20])
    assert "hil recover" in refused()
    (run / RECORDS_FILE).write_bytes(b"ARROW1\0\0" + b"\xff" * 40 + b"ARROW1")
    assert "an Arrow IPC file" in refused()
    later = table_of_bytes(whole).replace_schema_metadata({"format": "99"})
    with pa.ipc.new_file(run / RECORDS_FILE, later.schema) as sink:
        sink.write_table(later)
    assert "a recording of format 7 or earlier" in refused()
    (run / RECORDS_FILE).write_bytes(whole)
    assert "a place to write to" in refused("--out", str(tmp_path / "none" / "a.csv"))
    (run / RECORDS_FILE).unlink()
    assert "no records.arrow" in refused()


def table_of_bytes(content: bytes) -> pa.Table:
    return pa.ipc.open_file(pa.BufferReader(content)).read_all()
