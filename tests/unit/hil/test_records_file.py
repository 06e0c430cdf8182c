"""records.arrow as a whole file, and as one that was cut off at any place."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.loop.cycle_record import COLUMNS, NAMES, NOTHING
from servobench.hil.rows.arrow_file import is_whole
from servobench.hil.rows.events import RunZero
from servobench.hil.rows.records import Rows
from servobench.hil.rows.records_file import (
    RecordsWriter,
    column_of,
    finish_records,
    read_metadata,
    read_records,
    read_some,
    read_table,
    records_schema,
    records_table,
    refuse_later_format,
    rows_of_table,
)
from servobench.hil.rows.run_files import FORMAT
from servobench.hil.rows.side_rows import BeginEvent, TextEvent
from tests.told import ROOT
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records

ZERO = Instant(7_000_000_000)
PAGE = ROOT / "docs" / "recording.md"


def write(path: Path, rows: Rows, blocks: int = 3) -> list[int]:
    """The file's size after its head and after each block; the last is that with the footer."""
    writer = RecordsWriter(path)
    writer.begin({"bench": "synthetic"}, ZERO)
    sizes = [path.stat().st_size]
    for block in np.array_split(rows, blocks):
        writer.write(block)
        sizes.append(path.stat().st_size)
    writer.close()
    return [*sizes, path.stat().st_size]


@pytest.fixture
def rows() -> Rows:
    return rows_of(synthetic_records(300, origin=ZERO))


def test_the_format_is_that_of_the_documentation() -> None:
    assert f"**format {FORMAT}**" in PAGE.read_text()


def test_it_begins_with_the_magic_bytes_and_is_read_back_in_run_time(tmp_path: Path, rows: Rows) -> None:
    path = tmp_path / "records.arrow"
    write(path, rows)
    assert path.read_bytes()[:8] == b"ARROW1\0\0"
    assert pa.ipc.open_file(path).read_all().num_rows == 300
    found = np.concatenate(list(read_records(path)))
    assert found["due_at"].tolist() == [cycle * NS_PER_MS for cycle in range(300)]
    on_bench_clock = np.concatenate(list(read_records(path, ZERO)))
    assert on_bench_clock.tobytes() == rows.tobytes()


def test_nothing_is_null_and_no_number_stands_for_it(tmp_path: Path, rows: Rows) -> None:
    """Not even by accident: a delay of -1 ns is one."""
    rows = rows.copy()
    rows["delay_ns"][:2] = -1, NOTHING
    rows["statusword"][:2] = 0x1637, -1
    rows["torque_told_at"][:2] = ZERO - 1, -1
    rows["torque_nm"][:2] = 1.0, np.nan
    path = tmp_path / "records.arrow"
    write(path, rows)
    table = read_table(path).slice(0, 2).to_pydict()
    for name, known in {"delay_ns": -1, "statusword": 0x1637, "torque_told_at": -1, "torque_nm": 1.0}.items():
        assert table[name] == [known, None]
    assert np.concatenate(list(read_records(path, ZERO))).tobytes() == rows.tobytes()
    part = rows_of_table(read_table(path).slice(1, 40))
    assert part.tobytes() == rows_of_table(read_table(path))[1:41].tobytes()
    whole = pa.ipc.open_file(path).read_all()
    for column in whole.columns:
        if pa.types.is_integer(column.type) and column.null_count < len(column):
            assert pa.compute.min(column).as_py() > -(2**60)


def test_units_and_codes_are_with_the_columns(tmp_path: Path, rows: Rows) -> None:
    path = tmp_path / "records.arrow"
    write(path, rows)
    schema = pa.ipc.open_file(path).schema
    codes = json.loads(schema.field("fate").metadata[b"codes"])
    assert codes == {"0": "sample", "1": "lost", "2": "late", "3": "stale", "4": "missed"}
    assert schema.field("velocity_rad_s").metadata[b"unit"] == b"rad/s"
    assert schema.field("due_at").metadata[b"unit"] == b"ns since the first cycle"
    assert all(field.metadata[b"meaning"] for field in schema)
    assert read_metadata(path) == {"format": FORMAT, "bench": "synthetic"}


def test_columns_that_follow_others_are_held_as_differences_called_so(tmp_path: Path, rows: Rows) -> None:
    """Nulls in the one or the other and differences beyond 64 bits come back to the bit."""
    rows = rows.copy()
    rows["woke_at"][3] = NOTHING
    rows["device_time_ns"][4:6] = 2**63 - 1, -(2**63) + 2
    rows["estimate_position_rad"][5:9] = -0.0, np.nan, 1e300, np.inf
    rows["position_rad"][5:9] = 0.0, 1.0, -1e-300, np.nan
    path = tmp_path / "records.arrow"
    write(path, rows)
    assert np.concatenate(list(read_records(path, ZERO))).tobytes() == rows.tobytes()
    stored, whole = pa.ipc.open_file(path).read_all(), read_table(path)
    assert "woke_at" not in stored.column_names
    for name, (first, *others) in {
        "woke_at-due_at": ("woke_at", "due_at"),
        "received_at-sampled_at-delay_ns": ("received_at", "sampled_at", "delay_ns"),
    }.items():
        assert stored.field(name).metadata[b"unit"] == b"ns"
        expected = [
            None if known is None else known - sum(other or 0 for other in of)
            for known, *of in zip(*(whole[each].to_pylist() for each in (first, *others)), strict=True)
        ]
        assert stored[name].to_pylist() == expected
    same = [each.as_py() for each in stored["estimate_velocity_rad_s^velocity_rad_s"]]
    bits = [rows[name].view(np.int64) for name in ("estimate_velocity_rad_s", "velocity_rad_s")]
    both = ~np.isnan(rows["estimate_velocity_rad_s"]) & ~np.isnan(rows["velocity_rad_s"])
    assert np.array(same, object)[both].tolist() == (bits[0] ^ bits[1])[both].tolist()
    some = np.concatenate(list(read_records(path, ZERO, ("fate", "command_expires_at"))))
    assert some["command_expires_at"].tolist() == rows["command_expires_at"].tolist()


def test_one_up_to_format_6_has_the_columns_themselves_and_is_read_and_finished(
    tmp_path: Path, rows: Rows
) -> None:
    path, earlier = tmp_path / "records.arrow", tmp_path / "earlier.arrow"
    write(path, rows)
    with pa.ipc.new_file(earlier, read_table(path).schema) as writer:
        for batch in read_table(path).to_batches():
            writer.write_batch(batch)
    assert "woke_at" in pa.ipc.open_file(earlier).schema.names
    assert np.concatenate(list(read_records(earlier, ZERO))).tobytes() == rows.tobytes()
    again = tmp_path / "again.arrow"
    longer = RecordsWriter(again)
    longer.begin({}, ZERO, earlier)
    longer.copy(earlier)
    longer.write(rows[:7])
    longer.close()
    expected = np.concatenate([rows, rows[:7]]).tobytes()
    assert np.concatenate(list(read_records(again, ZERO))).tobytes() == expected


def test_batches_by_number_are_looked_at_as_whole_files_are(tmp_path: Path, rows: Rows) -> None:
    path = tmp_path / "records.arrow"
    rows = rows.copy()
    rows["command_fate"][150] = 99
    write(path, rows)
    (first,) = read_some(path, [1])
    assert first["due_at"].tolist() == (rows["due_at"][:100] - ZERO).tolist()
    with pytest.raises(BadInput, match="batch 3, column command_fate: found 99, expected 0 to 5"):
        list(read_some(path, [2]))


@pytest.mark.parametrize("whole_blocks", [0, 1, 2, 3])
@pytest.mark.parametrize("more", [0, 1, 100, -1])
def test_one_that_was_cut_off_is_finished(tmp_path: Path, rows: Rows, whole_blocks: int, more: int) -> None:
    path = tmp_path / "records.arrow"
    sizes = write(path, rows)
    end = sizes[whole_blocks] + (more if more >= 0 else sizes[whole_blocks + 1] - sizes[whole_blocks] - 1)
    path.write_bytes(path.read_bytes()[:end])
    expected = rows[: 100 * whole_blocks].tobytes()
    assert b"".join(batch.tobytes() for batch in read_records(path, ZERO)) == expected
    assert finish_records(path) == 100 * whole_blocks
    assert pa.ipc.open_file(path).read_all().num_rows == 100 * whole_blocks
    assert b"".join(batch.tobytes() for batch in read_records(path, ZERO)) == expected
    assert read_metadata(path) == {"format": FORMAT, "bench": "synthetic"}
    assert [found.name for found in tmp_path.iterdir()] == ["records.arrow"]


@pytest.mark.parametrize("size", [0, 3, 8, 20])
def test_one_without_a_head_becomes_an_empty_one(tmp_path: Path, rows: Rows, size: int) -> None:
    path = tmp_path / "records.arrow"
    write(path, rows)
    path.write_bytes(path.read_bytes()[:size])
    assert read_metadata(path) == {}
    assert finish_records(path) == 0
    assert pa.ipc.open_file(path).read_all().num_rows == 0


def test_one_of_an_earlier_format_lacks_what_was_not_recorded_then(tmp_path: Path, rows: Rows) -> None:
    path, earlier = tmp_path / "records.arrow", tmp_path / "earlier.arrow"
    write(path, rows)
    later = ["compute_ns", *[name for name in NAMES if name.startswith("channel_")]]
    table = pa.ipc.open_file(path).read_all().drop_columns(later)
    with pa.ipc.new_file(earlier, table.schema) as writer:
        writer.write_table(table)
    found = np.concatenate(list(read_records(earlier, ZERO)))
    assert (found["compute_ns"] == NOTHING).all()
    assert np.isnan(found["channel_0"]).all()
    assert found["due_at"].tolist() == rows["due_at"].tolist()
    assert found["command_acts_by"].tolist() == rows["command_acts_by"].tolist()


def test_a_whole_one_is_left_as_it_is(tmp_path: Path, rows: Rows) -> None:
    path = tmp_path / "records.arrow"
    write(path, rows)
    before = path.read_bytes(), path.stat().st_ino
    assert finish_records(path) == 300
    assert (path.read_bytes(), path.stat().st_ino) == before


@pytest.mark.parametrize("kept", [0, 100, 300])
def test_one_that_another_writer_began_is_finished_all_the_same(
    tmp_path: Path, rows: Rows, kept: int
) -> None:
    """Its batches are not the bytes that this one would write: they are written anew."""
    path, plain = tmp_path / "records.arrow", tmp_path / "plain.arrow"
    write(path, rows)
    table = read_table(path)
    with pa.OSFile(str(plain), "wb") as file, pa.ipc.new_file(file, table.schema) as writer:
        for batch in table.slice(0, kept).to_batches():
            writer.write_batch(batch)
        end = file.tell()
    plain.write_bytes(plain.read_bytes()[:end])
    assert not is_whole(plain)
    assert finish_records(plain) == kept
    assert is_whole(plain)
    assert rows_of_table(pa.ipc.open_file(plain).read_all()).tobytes() == (
        rows_of_table(table)[:kept].tobytes()
    )


def test_a_table_is_the_same_from_memory_and_from_a_file(tmp_path: Path, rows: Rows) -> None:
    path = tmp_path / "records.arrow"
    write(path, rows)
    table = read_table(path)
    assert table.equals(records_table(rows, {"bench": "synthetic"}, ZERO), check_metadata=True)
    moved = rows_of_table(table)
    assert moved["due_at"].tolist() == (rows["due_at"] - ZERO).tolist()
    assert moved["velocity_rad_s"].tobytes() == rows["velocity_rad_s"].tobytes()
    assert table.column("phase").to_pylist() == ["run"] * 300
    path.write_bytes(b"ARROW1")
    assert read_table(path).equals(records_table(rows[:0], {}, ZERO), check_metadata=True)
    assert rows_of_table(read_table(path)).size == 0


def test_a_field_tells_all_of_its_column() -> None:
    schema = records_schema({"bench": "x"})
    told = [column_of(schema.field(column.name)) for column in COLUMNS]
    assert [(each.name, each.unit, each.meaning, each.codes) for each in told] == [
        (each.name, each.unit, each.meaning, each.codes) for each in COLUMNS
    ]
    many = tuple(f"code {number}" for number in range(12))
    field = pa.field("x", pa.int64(), metadata={"codes": json.dumps(dict(enumerate(many)))})
    assert column_of(field).codes == many, "10 comes behind 9"
    bare = column_of(pa.field("x", pa.float64()))
    assert (bare.name, bare.kind, bare.unit, bare.meaning, bare.codes) == ("x", "double", "", "", ())


@pytest.mark.parametrize(
    ("told", "refused"),
    [
        (None, False),
        ("1", False),
        ("2", False),
        (FORMAT, False),
        (str(int(FORMAT) + 1), True),
        ("", True),
        ("2.0", True),
        ("²", True),
    ],
)
def test_a_later_format_is_refused_by_those_who_read_earlier_ones(told: str | None, refused: bool) -> None:
    metadata = {} if told is None else {"format": told}
    if not refused:
        refuse_later_format(metadata, Path("run"))
        return
    with pytest.raises(BadInput) as caught:
        refuse_later_format(metadata, Path("run"))
    assert str(caught.value) == (
        f"run: format: found {told!r}, expected a recording of format {FORMAT} or earlier; "
        "read it with the servobench that wrote it, or later"
    )


def test_a_writer_that_is_dropped_leaves_what_is_written_without_an_end(tmp_path: Path, rows: Rows) -> None:
    path = tmp_path / "records.arrow"
    writer = RecordsWriter(path)
    writer.begin({}, ZERO)
    writer.write(rows[:100])
    writer.drop()
    assert not is_whole(path)
    assert b"".join(batch.tobytes() for batch in read_records(path, ZERO)) == rows[:100].tobytes()


def test_the_time_zero_is_the_first_cycle_once_it_is_told() -> None:
    zero = RunZero(Instant(5))
    assert not zero.look([TextEvent(Instant(6), "INFO", "set up")])
    assert (zero.at, zero.told) == (5, False)
    assert zero.look([BeginEvent(Instant(9))])
    assert (zero.at, zero.told) == (9, True)
