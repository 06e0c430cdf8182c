"""The frames of a recording by column, as others read them, and after a kill or on a full disk."""

import random
import shutil
import subprocess
from pathlib import Path

import can
import duckdb
import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from servobench.hil.cli import app
from servobench.hil.recording.frame_files import FrameFiles, append_frames
from servobench.hil.reviewing.trace.run_trace import RecordedBus
from servobench.hil.rows.frames_file import BATCH_FRAMES, FramesWriter, read_batches, read_interfaces
from servobench.hil.rows.side_rows import FRAME_DTYPE, frame_row

EPOCH = 10**18
NAMES = ("can0", "feed")


def drawn(count: int, seed: int = 1) -> NDArray[np.void]:
    """Frames of every kind, in order of time."""
    dice, rows, at = random.Random(seed), [], 0
    for _ in range(count):
        at += dice.randrange(1, 400_000)
        can_id = dice.choice(
            [dice.randrange(0x800), dice.randrange(1 << 29) | EXTENDED_FLAG, 0x123 | REMOTE_FLAG]
        )
        if dice.random() < 0.02:
            can_id = 0x88 | ERROR_FLAG | EXTENDED_FLAG
        data = b"" if can_id & REMOTE_FLAG else dice.randbytes(dice.randrange(9))
        rows.append(frame_row(Instant(at), can_id, dice.randrange(4), data))
    return np.frombuffer(b"".join(rows), FRAME_DTYPE)


def recorded(folder: Path, frames: NDArray[np.void]) -> Path:
    files = FrameFiles(folder, NAMES)
    files.write(frames, Duration(EPOCH))
    files.close()
    return folder


def read(folder: Path) -> NDArray[np.void]:
    return np.concatenate([batch.frames for batch in read_batches(folder / "frames.arrow")])


def fields(frames: NDArray[np.void], offset: int = 0) -> list[tuple[object, ...]]:
    """Without the padding, which is any."""
    return [
        (int(row["at"]) + offset, *(row[name].tolist() for name in ("can_id", "length", "sent", "data")))
        for row in frames
    ]


def test_what_is_written_is_read_and_batches_are_bounded(tmp_path: Path) -> None:
    frames = drawn(BATCH_FRAMES + 100)
    recorded(tmp_path, frames)
    assert fields(read(tmp_path)) == fields(frames, EPOCH)
    assert [batch.frames.size for batch in read_batches(tmp_path / "frames.arrow")] == [0, BATCH_FRAMES, 100]
    assert read_interfaces(tmp_path / "frames.arrow") == NAMES


def test_duckdb_reads_it_by_way_of_pyarrow(tmp_path: Path) -> None:
    frames = drawn(500)
    recorded(tmp_path, frames)
    told_frames = pa.ipc.open_file(tmp_path / "frames.arrow").read_all()  # noqa: F841 - duckdb finds it
    answer = duckdb.sql(
        "select count(*), sum(dlc), sum(octet_length(data)), count(*) filter (sent),"
        " count(*) filter (extended), count(*) filter (error), max(epoch_ns(stamp)) from told_frames"
    )
    assert answer is not None
    (told,) = answer.fetchall()
    ids = frames["can_id"]
    error = (ids & ERROR_FLAG) != 0
    assert told == (
        500,
        frames["length"].sum(),
        frames["length"].sum(),
        (frames["sent"] & 1).sum(),
        (((ids & EXTENDED_FLAG) != 0) & ~error).sum(),
        error.sum(),
        EPOCH + int(frames["at"].max()),
    )


@pytest.mark.parametrize("kind", ["log", "asc", "blf", "pcap"])
def test_python_can_and_tshark_read_what_is_exported(tmp_path: Path, kind: str) -> None:
    frames = drawn(2_000)
    recorded(tmp_path, frames)
    done = CliRunner().invoke(app, ["export", str(tmp_path), "--to", kind])
    assert (done.exit_code, done.stdout) == (0, f"{tmp_path / f'frames.{kind}'}: 2000 rows\n")
    path = tmp_path / f"frames.{kind}"
    data = [row["data"].tobytes()[: row["length"]] for row in frames]
    if kind == "pcap":
        tshark = shutil.which("tshark")
        if tshark is None:
            pytest.skip("no tshark")
        command = [
            tshark,
            "-r",
            str(path),
            "-T",
            "fields",
            "-e",
            "frame.time_epoch",
            "-e",
            "can.id",
            "-e",
            "can.len",
        ]
        lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
        assert len(lines) == 2_000
        stamps = [line.split("\t")[0] for line in lines]
        assert stamps == [f"1000000000.{at:09d}" for at in frames["at"].tolist()]
        return
    found = list(can.LogReader(str(path)))
    assert [message.arbitration_id for message in found if not message.is_error_frame] == [
        int(can_id) & 0x1FFF_FFFF for can_id in frames["can_id"] if not can_id & ERROR_FLAG
    ]
    pairs = zip(found, frames["can_id"].tolist(), data, strict=True)
    kept = [(message, bytes_) for message, can_id, bytes_ in pairs if not can_id & (ERROR_FLAG | REMOTE_FLAG)]
    assert all(bytes(message.data) == bytes_ for message, bytes_ in kept)
    if kind != "log":
        assert [not message.is_rx for message in found if not message.is_error_frame] == [
            bool(sent & 1)
            for sent, can_id in zip(frames["sent"].tolist(), frames["can_id"].tolist(), strict=True)
            if not can_id & ERROR_FLAG
        ]


@pytest.mark.parametrize("cut", [0.3, 0.6, 0.99])
def test_a_file_that_was_cut_off_has_its_whole_batches_and_more_are_put_behind(
    tmp_path: Path, cut: float
) -> None:
    frames = drawn(1_000)
    files = FrameFiles(tmp_path, NAMES)
    for begin in range(0, 1_000, 100):
        files.write(frames[begin : begin + 100], Duration(EPOCH))
    path = tmp_path / "frames.arrow"
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * cut)])
    left = read(tmp_path).size
    assert left in range(int(1_000 * cut) - 200, 1_000)
    append_frames(path, NAMES, frames[left:], Duration(EPOCH))
    assert fields(read(tmp_path)) == fields(frames, EPOCH)
    assert pa.ipc.open_file(path).read_all().num_rows == 1_000
    assert [frame.number for frame in RecordedBus(tmp_path)] == list(range(1, 1_001))


def test_frames_cut_off_are_told_by_a_trace_and_not_exported(tmp_path: Path) -> None:
    path = recorded(tmp_path, drawn(1_000)) / "frames.arrow"
    path.write_bytes(path.read_bytes()[:-40])
    words = ["export", str(tmp_path), "--to", "log", "--out", str(tmp_path / "out.log"), "--unsealed"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2
    assert "frames.arrow: found 'no end of the file'" in done.stderr
    assert not (tmp_path / "out.log").exists()
    traced = CliRunner().invoke(app, ["trace", str(tmp_path), "--unsealed"])
    assert (traced.exit_code, "frames.arrow has no end; told as far as it goes" in traced.output) == (0, True)


def test_a_batch_that_finds_no_room_leaves_whole_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = drawn(300)
    files = FrameFiles(tmp_path, NAMES)
    files.write(frames[:200], Duration(EPOCH))
    size = (tmp_path / "frames.arrow").stat().st_size

    def half(writer: FramesWriter, part: NDArray[np.void], offset: int) -> int:
        del writer, part, offset
        raise OSError("No space left on device")

    monkeypatch.setattr(FramesWriter, "write", half)
    with pytest.raises(OSError, match="No space"):
        files.write(frames[200:], Duration(EPOCH))
    assert (tmp_path / "frames.arrow").stat().st_size == size
    assert fields(read(tmp_path)) == fields(frames[:200], EPOCH)


def test_what_holds_no_frames_is_refused_by_place(tmp_path: Path) -> None:
    path = tmp_path / "frames.arrow"
    table = pa.table({"stamp": [1, 2], "other": ["a", "b"]})
    with pa.ipc.new_file(path, table.schema) as sink:
        sink.write_table(table)
    with pytest.raises(BadInput, match=r"frames\.arrow: "):
        list(read_batches(path))
    with pytest.raises(BadInput, match=r"frames\.arrow: interfaces"):
        RecordedBus(tmp_path)


def test_frames_of_an_earlier_format_are_not_exported_and_the_message_says_where_they_are(
    tmp_path: Path,
) -> None:
    (tmp_path / "frames.log").write_text("(1.000000) can0 080#\n")
    done = CliRunner().invoke(app, ["export", str(tmp_path), "--to", "log"])
    assert done.exit_code == 2
    assert "frames.log is candump's log" in done.stderr
