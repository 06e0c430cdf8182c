"""The frames of a recording: who sent each, when, and what its bench file says of the drives."""

from pathlib import Path

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Instant
from servobench.hil.reviewing.trace.decoder import decode
from servobench.hil.reviewing.trace.frame_columns import LogFrame
from servobench.hil.reviewing.trace.run_trace import RecordedBus
from servobench.hil.rows.records_file import RecordsWriter
from servobench.hil.rows.run_files import DIRECTIONS_FILE, FIRST_CYCLE_EPOCH, FRAMES_LOG
from servobench.hil.rows.side_rows import FRAME_DTYPE
from tests.told import ROOT
from tests.unit.drivers.eds_maker import Pdo, sheet_text
from tests.unit.hil.row_tools import plain_rows
from tests.unit.hil.test_trace_decoder import frames

EXAMPLES = ROOT / "examples"
ZERO_NS = 100_000_000_000
LINES = ("080#", "181#0102", "201#00", "581#4B776000F4010000", "601#4077600000000000")


def recorded(folder: Path, *lines: str, directions: str | None = None, **metadata: str) -> Path:
    """Frames a microsecond apart, the first at 100 s of the log."""
    log = [f"(100.{number:06d}) can0 {line}\n" for number, line in enumerate(lines)]
    (folder / FRAMES_LOG).write_text("".join(log))
    if directions is not None:
        (folder / DIRECTIONS_FILE).write_text("".join(f"{letter}\n" for letter in directions))
    if metadata:
        writer = RecordsWriter(folder / "records.arrow")
        writer.begin(metadata, Instant(0))
        writer.write(plain_rows(1))
        writer.close()
    return folder


def test_a_folder_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput) as refused:
        RecordedBus(tmp_path)
    assert str(refused.value) == (
        f"{tmp_path}: found 'no frames', "
        "expected a recording with frames.arrow (recording.frames of its bench)"
    )


def test_a_later_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="expected a recording of format 7 or earlier"):
        RecordedBus(recorded(tmp_path, *LINES, format="8"))
    assert RecordedBus(recorded(tmp_path, *LINES, format="4")).notes == []


@pytest.mark.parametrize(
    ("metadata", "zero_ns"), [({FIRST_CYCLE_EPOCH: "1234"}, 1234), ({"other": "1"}, None), ({}, None)]
)
def test_the_first_cycle_is_where_the_records_have_it(
    tmp_path: Path, metadata: dict[str, str], zero_ns: int | None
) -> None:
    assert RecordedBus(recorded(tmp_path, *LINES, **metadata)).zero_ns == zero_ns


@pytest.mark.parametrize(
    ("directions", "sent"),
    [
        (None, ["", "", "", "", ""]),
        ("TRTRT", ["T", "R", "T", "R", "T"]),
        ("TRTRTTTT", ["T", "R", "T", "R", "T"]),
        ("TRT", ["T", "R", "T", "", ""]),
        ("", ["", "", "", "", ""]),
    ],
)
def test_each_frame_has_its_own_direction_as_far_as_they_go(
    tmp_path: Path, directions: str | None, sent: list[str]
) -> None:
    bus = RecordedBus(recorded(tmp_path, *LINES, directions=directions))
    seen = list(bus)
    assert [frame.sent for frame in seen] == sent
    plain = [
        LogFrame(number, ZERO_NS + 1_000 * (number - 1), "can0", int(can_id, 16), bytes.fromhex(data))
        for number, (can_id, _, data) in enumerate((line.partition("#") for line in LINES), 1)
    ]
    assert [frame._replace(sent="") for frame in seen] == plain
    assert bus.log.frames == len(LINES)


def test_directions_count_lines_of_the_log_whatever_they_hold(tmp_path: Path) -> None:
    folder = recorded(tmp_path, *LINES, directions="TTRTR")
    lines = (folder / FRAMES_LOG).read_text().splitlines()
    (folder / FRAMES_LOG).write_text("\n".join([lines[0], "no frame", *lines[2:]]) + "\n")
    assert [(frame.number, frame.sent) for frame in RecordedBus(folder)] == [
        (1, "T"), (3, "R"), (4, "T"), (5, "R"),
    ]  # fmt: skip


def test_frames_as_rows_count_from_the_first_cycle_and_by_segment(tmp_path: Path) -> None:
    folder = recorded(tmp_path, **{FIRST_CYCLE_EPOCH: str(ZERO_NS + 1_000)})
    (folder / FRAMES_LOG).write_text(
        "(100.000000) can0 080#\n(100.000001) axis 181#0102\n"
        "(100.000002) other 182#1122334455667788\n(100.000003) can0 123##0112233445566778899\n"
        "(100.000004) can0 20000008#0000000000000000\n(100.000005) last 183#FF\n"
    )
    (rows,) = RecordedBus(folder).arrays(["axis", "last"])
    assert rows.dtype == FRAME_DTYPE
    assert rows["at"].tolist() == [-1_000, 0, 1_000, 4_000]
    assert rows["can_id"].tolist() == [0x080, 0x181, 0x182, 0x183]
    assert rows["sent"].tolist() == [0, 1 << 1, 0, 2 << 1]
    assert rows["length"].tolist() == [0, 2, 8, 1]
    assert rows["data"].tolist()[2] == [0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88]
    assert not np.any(rows["data"][0])


def test_without_a_first_cycle_rows_count_as_the_log_and_none_are_no_block(tmp_path: Path) -> None:
    (rows,) = RecordedBus(recorded(tmp_path, "080#")).arrays([])
    assert rows["at"].tolist() == [ZERO_NS]
    assert list(RecordedBus(recorded(tmp_path)).arrays([])) == []


DRIVE_FILE = (
    "[drive]\nnode = 1\nvendor = 1\nproduct = 1\n[scale]\nrated_torque_nm = 2.0\n[signs]\ntorque = -1\n"
)
TORQUE = ("601#4077600000000000", "581#4B776000F4010000")


def bench_text(keys: str) -> str:
    text = (EXAMPLES / "any_bus.toml").read_text()
    return text.replace("node = 1\n", f"node = 1\n{keys}\n", 1).replace('"motors/', f'"{EXAMPLES}/motors/')


def torque(bus: RecordedBus, channel: str) -> float | None:
    return list(decode(frames(TORQUE, channel), bus.known([])))[-1].values[0].si


def test_the_factors_of_a_commissioned_drive_are_those_of_its_bus(tmp_path: Path) -> None:
    folder = recorded(tmp_path, *LINES, bus="socketcan:can3")
    (folder / "drive.toml").write_text(DRIVE_FILE)
    (folder / "bench.toml").write_text(bench_text('commissioned = "drive.toml"'))
    bus = RecordedBus(folder)
    assert (torque(bus, "can3"), torque(bus, "can0")) == (-1.0, None)
    assert bus.notes == []


def test_the_sheet_of_a_bench_is_for_its_own_node_and_bus_behind_those_of_the_user(tmp_path: Path) -> None:
    folder = recorded(tmp_path, *LINES, bus="can3")
    (folder / "own.eds").write_text(sheet_text([Pdo(0x1800, (0x6041_0010,))]))
    (folder / "bench.toml").write_text(bench_text(f'eds = "{folder / "own.eds"}"'))
    bus = RecordedBus(folder)

    def first_pdo(channel: str, node: int) -> str:
        frame = LogFrame(1, 0, channel, 0x180 + node, b"\x37\x12")
        (entry,) = decode([frame], bus.known([]))
        return entry.text

    assert first_pdo("can3", 1) == "TPDO1 6041h:00 Object 6041 = 1237h (operation enabled)"
    assert first_pdo("can3", 2) == first_pdo("can0", 1) == "TPDO1 37 12 (its mapping is not known)"
    assert bus.notes == []


def test_a_sheet_of_the_bench_that_cannot_be_read_is_a_note(tmp_path: Path) -> None:
    folder = recorded(tmp_path, *LINES, bus="can3")
    lost = folder / "lost.eds"
    lost.write_text(sheet_text([]))
    (folder / "bench.toml").write_text(bench_text(f'eds = "{lost}"'))
    lost.write_text("rubbish")
    bus = RecordedBus(folder)
    bus.known([])
    (note,) = bus.notes
    assert note.startswith(f"{lost}: found ")
    assert note.endswith("; --eds 1=FILE gives it")


def test_a_bench_file_that_cannot_be_read_is_a_note(tmp_path: Path) -> None:
    bus = RecordedBus(recorded(tmp_path, *LINES))
    assert torque(bus, "can0") is None
    (note,) = bus.notes
    assert note.startswith("the bench file tells nothing of the drives: ")
    assert str(tmp_path / "bench.toml") in note
