"""Rows that no recording has: each reader refuses them by file, batch and column, and takes no gigabytes."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pyarrow as pa
import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.rows.records_file import BATCH_ROWS_MAX
from tests.unit.hil.recorded_runs import short_run

MEASURED: Final = """
import resource, subprocess, sys
status = subprocess.run(sys.argv[1:]).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(status)
"""
"""Runs a command, and prints its largest memory in kB: that of this process's other children is larger."""
READERS: dict[str, Callable[[Path], list[str]]] = {
    "review": lambda run: ["review", str(run)],
    "compare": lambda run: ["compare", str(run), str(run)],
    "export": lambda run: ["export", str(run), "--to", "csv", "--out", str(run / "out.csv")],
    "why": lambda run: ["why", str(run)],
    "picture": lambda run: ["picture", str(run), str(run / "out.svg"), "--paper"],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return short_run(tmp_path_factory.mktemp("whole") / "run")


def damaged(run: Path, folder: Path, change: Callable[[pa.Table], pa.Table]) -> Path:
    """A copy of the run with other rows."""
    copy = Path(shutil.copytree(run, folder / "copy"))
    table = pa.ipc.open_file(pa.BufferReader((run / "records.arrow").read_bytes())).read_all()
    changed = change(table).combine_chunks()
    with pa.ipc.new_file(copy / "records.arrow", changed.schema) as sink:
        sink.write_table(changed)
    return copy


def with_values(
    name: str, value: int | float | None, kind: str | None = None
) -> Callable[[pa.Table], pa.Table]:
    """``value`` in the tenth row of a column."""

    def change(table: pa.Table) -> pa.Table:
        place, field = table.schema.names.index(name), table.schema.field(name)
        values = table.column(name).to_pylist()
        values[9] = value
        other = field.with_type(pa.type_for_alias(kind)) if kind else field
        return table.set_column(place, other, pa.array(values, other.type))

    return change


def without(name: str) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.drop_columns([name])


NULLS = "found '1 nulls', expected a value in each row"
CASES: dict[str, tuple[Callable[[pa.Table], pa.Table], str]] = {
    "fate 99": (with_values("fate", 99), "batch 1, column fate: found 99, expected 0 to 4"),
    "fate -1": (with_values("fate", -1), "batch 1, column fate: found -1, expected 0 to 4"),
    "no fate": (with_values("fate", None), f"batch 1, column fate: {NULLS}"),
    "fate missing": (without("fate"), "column fate: found 'no such column', expected int8"),
    "fate as a number": (with_values("fate", 0.5, "float64"), "column fate: found 'double', expected int8"),
    "a fate of commands": (with_values("command_fate", 6), "column command_fate: found 6, expected 0 to 5"),
    "no instant": (with_values("due_at", None), f"batch 1, column due_at: {NULLS}"),
    "axis 7": (with_values("axis", 7), "batch 1, column axis: found 7, expected 0 to 0"),
    "axis -1": (with_values("axis", -1), "batch 1, column axis: found -1, expected 0 to 0"),
}


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_what_stands_for_nothing_is_refused_by_every_reader(run: Path, tmp_path: Path, case: str) -> None:
    change, told = CASES[case]
    copy = damaged(run, tmp_path, change)
    for name, arguments in READERS.items():
        if (name, case) == ("why", "a fate of commands"):
            continue  # it reads that column of the cycles around a breach alone
        ended = CliRunner().invoke(app, [*arguments(copy), "--unsealed"])
        assert ended.exit_code == 2, (name, ended.output)
        assert f"{copy / 'records.arrow'}: " in ended.output, name
        assert told in ended.output, name
    shown = CliRunner().invoke(app, ["trace", str(copy), "--unsealed"])
    assert shown.exit_code == 0, "its frames can be shown all the same"


@pytest.mark.long
def test_a_batch_of_twenty_million_rows_is_refused_before_it_is_unpacked(run: Path, tmp_path: Path) -> None:
    """On disk it has a few megabytes."""
    rows = 20 * BATCH_ROWS_MAX
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    schema = pa.ipc.open_file(pa.BufferReader((run / "records.arrow").read_bytes())).schema
    zeros = pa.py_buffer(bytes(8 * rows))
    columns = [
        pa.Array.from_buffers(field.type, rows, [None, zeros])
        if field.name != "phase"
        else pa.DictionaryArray.from_arrays(pa.Array.from_buffers(pa.int8(), rows, [None, zeros]), ["run"])
        for field in schema
    ]
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    with pa.ipc.new_file(copy / "records.arrow", schema, options=options) as sink:
        sink.write_batch(pa.record_batch(columns, schema=schema))
    del columns
    assert (copy / "records.arrow").stat().st_size < 1 << 25
    command = [sys.executable, "-m", "servobench.hil.cli", "review", str(copy), "--unsealed"]
    measuring = [sys.executable, "-c", MEASURED, *command]
    ended = subprocess.run(measuring, capture_output=True, text=True, check=False)
    assert ended.returncode == 2, ended.stderr
    assert f"batch 1: found '{rows} rows', expected at most {BATCH_ROWS_MAX}" in ended.stderr
    assert int(ended.stdout) < 800_000, "kB"


@pytest.mark.long
def test_half_a_file_is_not_compared_and_is_drawn_as_far_as_it_goes(run: Path, tmp_path: Path) -> None:
    """Its rows are those of the whole one, as far as they go: a gate would pass them."""
    half = Path(shutil.copytree(run, tmp_path / "half"))
    records = half / "records.arrow"
    records.write_bytes(records.read_bytes()[:-100])
    compared = CliRunner().invoke(app, ["compare", str(run), str(half), "--unsealed"])
    assert compared.exit_code == 2
    drawn = CliRunner().invoke(app, ["picture", str(half), str(half / "out.svg"), "--paper", "--unsealed"])
    assert drawn.exit_code == 0
    assert f"hil: note: {records}: no end of the file; drawn as far as it goes" in drawn.stderr
    assert (half / "out.svg").exists()
