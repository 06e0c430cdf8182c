"""Logs that python-can writes, read by ``hil trace``: each of their frames; files with none."""

import gzip
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can
import pytest
from typer.testing import CliRunner, Result

from servobench.hil.cli import app
from servobench.hil.reviewing.trace.bus_log import BusLog

KINDS = ["asc", "blf", "csv", "db", "trc"]


def hil_trace(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["trace", *arguments])


def drawn(seed: int, count: int) -> list[can.Message]:
    """Frames 0.2 to 3 ms apart, of one adapter."""
    dice, at_s = random.Random(seed), 1_700_000_000.0
    messages = []
    for _ in range(count):
        at_s += dice.uniform(0.0002, 0.003)
        extended = dice.random() < 0.1
        messages.append(
            can.Message(
                timestamp=round(at_s, 6),
                arbitration_id=dice.randrange(1 << 29 if extended else 0x800),
                is_extended_id=extended,
                data=dice.randbytes(dice.randrange(9)),
                is_rx=dice.random() < 0.5,
                channel=0,
            )
        )
    return messages


def written(path: Path, messages: Sequence[can.Message]) -> Path:
    with can.Logger(path) as log:
        for message in messages:
            log.on_message_received(message)
    return path


def content(frame: Any) -> tuple[int, bool, bytes]:
    return frame.can_id, frame.extended, frame.data


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_each_frame_is_there(tmp_path: Path, kind: str, seed: int) -> None:
    messages = drawn(seed, 200)
    frames = list(BusLog(written(tmp_path / f"log.{kind}", messages)))
    assert list(map(content, frames)) == [
        (m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in messages
    ]
    assert [frame.number for frame in frames] == list(range(1, 201))
    begin_ns = frames[0].at_ns
    assert begin_ns is not None
    for frame, message in zip(frames, messages, strict=True):
        assert frame.at_ns is not None
        since_s = message.timestamp - messages[0].timestamp
        assert frame.at_ns - begin_ns == pytest.approx(since_s * 1e9, abs=101_000), "asc and trc have 0.1 ms"
    if kind in ("csv", "db"):
        assert {frame.sent for frame in frames} == {""}, "the file does not tell"
    else:
        assert [frame.sent for frame in frames] == ["R" if m.is_rx else "T" for m in messages]


@pytest.mark.parametrize("kind", KINDS)
def test_what_they_say_is_decoded(tmp_path: Path, kind: str) -> None:
    said = [(0x080, ""), (0x701, "05"), (0x601, "4041600000000000"), (0x581, "4B41600037060000")]
    messages = [
        can.Message(
            timestamp=1.0 + number, arbitration_id=can_id, data=bytes.fromhex(text), is_extended_id=False
        )
        for number, (can_id, text) in enumerate(said)
    ]
    done = hil_trace(str(written(tmp_path / f"log.{kind}", messages)))
    assert done.exit_code == 0
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["0.000000", "1.000000", "3.000000"]
    assert lines[-1].endswith("read 6041h:00 Statusword = 637h (operation enabled)")


def test_a_packed_one_is_read(tmp_path: Path) -> None:
    plain = written(tmp_path / "log.asc", drawn(1, 20))
    packed = tmp_path / "log.asc.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    assert list(map(content, BusLog(packed))) == list(map(content, BusLog(plain)))


@pytest.mark.parametrize("kind", ["asc", "blf", "csv", "db", "trc", "log", "pcap", "txt"])
@pytest.mark.parametrize(
    "data", [b"", b"some words\nand more\n", bytes(range(256))], ids=["empty", "text", "bytes"]
)
def test_a_file_without_a_frame_is_refused(tmp_path: Path, kind: str, data: bytes) -> None:
    path = tmp_path / f"log.{kind}"
    path.write_bytes(data)
    done = hil_trace(str(path))
    assert done.exit_code == 2
    assert done.stderr.startswith(f"hil: error: {path}: found ")
    endings = ".asc, .blf, .csv, .db, .mf4, .trc"
    assert done.stderr.endswith(
        f"expected a log of candump or SavvyCAN, a pcap or pcapng, or one of {endings}\n"
    )


SAVVY = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"


def test_rows_of_savvycan_that_hold_no_frame_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    short, wrong = "6000,181,false,Tx,1,9,0A,", "7000,zz,false,Rx,0,0,"
    rows = ("5000,181,false,Tx,1,2,0A,0B,00,", short, wrong, "8000,181")
    path.write_text(SAVVY + "".join(f"{row}\n" for row in rows) + "9000,00000801,false,Rx,0,1,7F,\n")
    log = BusLog(path)
    first, last = log
    assert (first.number, first.at_ns, first.channel, first.sent) == (2, 5_000_000, "1", "T")
    assert content(first) == (0x181, False, b"\x0a\x0b")
    assert content(last) == (0x801, True, b"\x7f"), "SavvyCAN takes it for an extended one, too"
    assert log.notes() == [f"3 lines or packets are no CAN frame, the first line 3: '{short}'"]


def test_a_savvycan_file_with_no_row_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(SAVVY)
    done = hil_trace(str(path))
    assert (done.exit_code, "found 'no frame'" in done.stderr) == (2, True)


@pytest.mark.parametrize(("kind", "told"), [("csv", True), ("blf", False)])
def test_one_that_is_cut_off_is_read_as_far_as_it_goes(tmp_path: Path, kind: str, told: bool) -> None:
    """Of a blf python-can says nothing."""
    messages = drawn(2, 5000)
    path = written(tmp_path / f"log.{kind}", messages)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2 - 3])
    log = BusLog(path)
    frames = list(map(content, log))
    assert 0 < len(frames) < 5000
    assert frames == [(m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in messages[: len(frames)]]
    assert bool(log.damage) is told
    assert ("it cannot be read to its end" in hil_trace(str(path)).stderr) is told
