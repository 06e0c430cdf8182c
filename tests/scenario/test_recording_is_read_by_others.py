"""The files of a run as programs read them that have nothing to do with the bench.

A program that is not there skips its test, but not in CI, where all are to be there.
"""

import os
import shutil
import subprocess
from types import ModuleType
from typing import Any

import can
import numpy as np
import pyarrow as pa
import pytest

from servobench.hil.loop.cycle_record import COLUMNS
from servobench.hil.rows.differences import DIFFERENCES
from servobench.hil.rows.records_file import PHASE_COLUMN, read_metadata
from servobench.hil.rows.run_files import FORMAT, RECORDS_FILE
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.run import Run
from tests.recorded_frames import candump, candump_text
from tests.scenario.processes import EXAMPLES

TSHARK_MAX_S = 60


def lacking(what: str) -> None:
    """Skip; in CI fail."""
    if os.environ.get("CI"):
        pytest.fail(f"{what} is not here, and in CI it must be")
    pytest.skip(f"{what} is not here")


def module(name: str) -> ModuleType:
    """An optional one."""
    if os.environ.get("CI"):
        return __import__(name)
    found: ModuleType = pytest.importorskip(name)
    return found


@pytest.fixture
def run(servo_bench: BenchRunner) -> Run:
    """With faults, an EMCY-free end, and another node's traffic on the bus."""
    return servo_bench(EXAMPLES / "ling2012.toml", {"bus.background": [{"can_id": 0x0A1, "period_us": 5000}]})


def counts(run: Run) -> tuple[int, int, int]:
    """Rows, rows with a reading that came, and the sum of their delays, ns: by pyarrow."""
    table = pa.ipc.open_file(run.folder / RECORDS_FILE).read_all()
    delays = table["delay_ns"].drop_null()
    return table.num_rows, len(delays), int(pa.compute.sum(delays).as_py())


def test_python_can_reads_every_frame_in_order_and_in_run_time(run: Run) -> None:
    with can.CanutilsLogReader(candump(run.folder)) as reader:
        messages = list(reader)
    lines = candump_text(run.folder).splitlines()
    stamps = [message.timestamp for message in messages]
    assert len(messages) == len(lines) == len(run.wire.frames) > 8000
    assert stamps == sorted(stamps)
    anchor = int(read_metadata(run.folder / RECORDS_FILE)["first_cycle_epoch_ns"]) / 1e9
    times_s = np.array([frame.at for frame in run.wire.frames]) / 1e9
    np.testing.assert_allclose(np.array(stamps) - anchor, times_s, atol=2e-6)
    assert {message.channel for message in messages} == {"simulated"}
    for line, frame in zip(lines, run.wire.frames, strict=True):
        assert line.split()[2] == frame.text


def test_pyarrow_reads_columns_nulls_and_what_the_run_was(run: Run) -> None:
    table = pa.ipc.open_file(run.folder / RECORDS_FILE).read_all()
    assert table.column_names == [
        DIFFERENCES.get(column.name, column.name) for column in (*COLUMNS, PHASE_COLUMN)
    ]
    assert table["phase"].unique().to_pylist() == ["run"]
    dropped = pa.compute.sum(pa.compute.not_equal(table["fate"], 0)).as_py()
    assert dropped == table["sampled_at-sync_on_bus_at"].null_count == run.summary.dropouts.total > 0
    assert table["sequence"].to_pylist() == list(range(1, run.summary.cycles + 1))
    metadata = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
    assert metadata["format"] == FORMAT
    assert metadata["seed"] == str(run.summary.seed)
    assert "serial 1" in metadata["drives"]
    assert metadata["bench_start_ns"].startswith("-")


def test_pandas_reads_the_records(run: Run) -> None:
    frame: Any = module("pandas").read_feather(run.folder / RECORDS_FILE)
    delays = frame["delay_ns"].dropna()
    assert (len(frame), len(delays), int(delays.sum())) == counts(run)
    assert (frame["phase"] == "run").all()


def test_polars_reads_the_records(run: Run) -> None:
    frame: Any = module("polars").read_ipc(run.folder / RECORDS_FILE)
    delays = frame["delay_ns"].drop_nulls()
    assert (len(frame), len(delays), int(delays.sum())) == counts(run)
    assert (frame["phase"] == "run").all()


def test_duckdb_reads_the_records_by_pyarrow(run: Run) -> None:
    duckdb: Any = module("duckdb")
    connection = duckdb.connect()
    connection.register("records", pa.ipc.open_file(run.folder / RECORDS_FILE).read_all())
    query = "select count(*), count(delay_ns), sum(delay_ns) from records where phase = 'run'"
    assert tuple(int(value) for value in connection.execute(query).fetchone()) == counts(run)


def test_tshark_reads_every_frame_and_finds_none_malformed(run: Run) -> None:
    tshark = os.environ.get("TSHARK") or shutil.which("tshark")
    if tshark is None:
        lacking("tshark")
        return
    fields = ["frame.time_epoch", "can.id", "can.len", "can.flags.err", "_ws.malformed"]
    command = [tshark, "-r", str(candump(run.folder)), "-T", "fields"]
    command += [part for name in fields for part in ("-e", name)]
    found = subprocess.run(command, capture_output=True, text=True, timeout=TSHARK_MAX_S, check=False)
    assert found.returncode == 0, found.stderr
    seen = [line.split("\t") for line in found.stdout.splitlines()]
    frames = run.wire.frames
    assert len(seen) == len(frames)
    assert [int(line[1], 0) for line in seen] == [frame.can_id for frame in frames]
    assert [int(line[2]) for line in seen] == [len(frame.data) for frame in frames]
    assert not any(line[4] for line in seen)
    stamps = [float(line[0]) for line in seen]
    assert stamps == sorted(stamps)
