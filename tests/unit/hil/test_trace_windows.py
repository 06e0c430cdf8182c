"""A window of a recording's bus has the lines that it has in the whole trace, each of them, and no other.

The logs are drawn: SDO transfers of every kind that begin, end or break off at its borders, nodes first heard
by anything, node guarding, mappings changed in between, two segments, frames of strangers.
"""

import json
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from servobench.hil.cli import app
from servobench.hil.recording.frame_files import FrameFiles
from servobench.hil.reviewing.trace.bus_log import BusLog
from servobench.hil.reviewing.trace.run_trace import RecordedBus
from servobench.hil.rows.frames_file import INDEX_DTYPE, read_index
from servobench.hil.rows.run_files import DIRECTIONS_FILE, FRAMES_LOG, INDEX_FILE
from servobench.hil.rows.side_rows import FRAME_DTYPE, frame_row
from tests.draws import few_of
from tests.unit.hil.test_run_trace import recorded

FRAMES: Final = 600
MAP_SPEED: Final = ("2300160100000000", "23001A0120006C60", "2F001A0001000000")


def hil_trace(*arguments: str) -> list[dict[str, Any]]:
    done = CliRunner().invoke(app, ["trace", *arguments, "--json", "--unsealed"])
    assert done.exit_code == 0, done.output
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def transfer(dice: random.Random, node: int) -> Iterator[str]:
    """A write or a read of some object, frame by frame; now and then nobody answers."""
    ask, answer = f"{0x600 + node:03X}#", f"{0x580 + node:03X}#"
    kind = dice.choice(["read", "write", "map", "segments", "unanswered", "aborted", "stray"])
    index = dice.choice(["6C6000", "416000", "006018", "181001", "001800"])
    if kind == "read":
        yield f"{ask}40{index}00000000"
        yield f"{answer}43{index}{dice.randbytes(4).hex().upper()}"
    elif kind == "write":
        yield f"{ask}23{index}{dice.randbytes(4).hex().upper()}"
        yield f"{answer}60{index}00000000"
    elif kind == "map":
        for request in MAP_SPEED:
            yield f"{ask}{request}"
            yield f"{answer}60{request[2:8]}00000000"
    elif kind == "segments":
        yield f"{ask}4008100000000000"
        yield f"{answer}410810000E000000"
        for toggle, text in ((0, "7365727665"), (1, "7365727665")):
            yield f"{ask}{'70' if toggle else '60'}00000000000000"
            yield f"{answer}{'15' if toggle else '00'}{text}0000"
    elif kind == "unanswered":
        yield f"{ask}40{index}00000000"
    elif kind == "aborted":
        yield f"{ask}40{index}00000000"
        yield f"{answer}80{index}00000206"
    else:
        yield f"{answer}43{index}00000000"


def others(dice: random.Random, node: int) -> str:
    return dice.choice(
        [
            "080#", "000#0101", f"{0x80 + node:03X}#1042000000000000", f"{0x700 + node:03X}#05",
            f"{0x700 + node:03X}#R", f"{0x700 + node:03X}#85", f"{0x180 + node:03X}#01020304",
            f"{0x280 + node:03X}#370600000000", f"{0x200 + node:03X}#0F00", f"{0x180 + node:03X}#R",
            "00012345#0011", "20000004#0008000000000000", "7E5#0400000000000000", "123#",
        ]
    )  # fmt: skip


def drawn_log(folder: Path, seed: int) -> None:
    """frames.log with its directions; frames 10 ms apart, some 0.4 s, some at one instant."""
    dice = random.Random(seed)
    channels = ["can0"] if dice.random() < 0.5 else ["can0", "axis3"]
    busy: dict[tuple[str, int], Iterator[str]] = {}
    lines: list[str] = []
    at_s = 100.0
    while len(lines) < FRAMES:
        at_s += dice.choice([0, 0.01, 0.01, 0.01, 0.4])
        channel, node = dice.choice(channels), dice.choice([1, 2, 3, 9])
        text = others(dice, node)
        if dice.random() < 0.4:
            text = next(busy.setdefault((channel, node), transfer(dice, node)), "")
            if not text:
                busy[channel, node] = transfer(dice, node)
                continue
        lines.append(f"({at_s:.6f}) {channel} {text}\n")
    (folder / FRAMES_LOG).write_text("".join(lines))
    (folder / DIRECTIONS_FILE).write_text("".join(f"{dice.choice('TR')}\n" for _ in lines))


def written_by_a_recorder(folder: Path, seed: int) -> None:
    """The same log as the files of a run's frames, in blocks; of every second one the index was cut off."""
    dice, frames = random.Random(seed), list(BusLog(folder / FRAMES_LOG))
    channels = list(dict.fromkeys(frame.channel for frame in frames))
    directions = (folder / DIRECTIONS_FILE).read_text()[::2]
    files, rows = FrameFiles(folder, tuple(channels)), list[bytes]()
    for frame, way in zip(frames, directions, strict=True):
        flags = EXTENDED_FLAG if frame.extended else EXTENDED_FLAG | ERROR_FLAG if frame.error else 0
        flags |= REMOTE_FLAG if frame.remote else 0
        sent = channels.index(frame.channel) << 1 | (way == "T")
        rows.append(frame_row(Instant(frame.at_ns or 0), frame.can_id | flags, sent, frame.data))
    while rows:
        count = dice.randrange(1, 60)
        files.write(np.frombuffer(b"".join(rows[:count]), FRAME_DTYPE), Duration(0))
        del rows[:count]
    files.close()
    told = [frame._replace(sent=way) for frame, way in zip(frames, directions, strict=True)]
    assert list(RecordedBus(folder)) == told
    (folder / FRAMES_LOG).unlink()
    (folder / DIRECTIONS_FILE).unlink()
    index = (folder / INDEX_FILE).read_bytes()
    assert len(read_index(folder)) * INDEX_DTYPE.itemsize == len(index)
    if seed % 2:
        (folder / INDEX_FILE).write_bytes(index[: dice.randrange(len(index))])


@pytest.mark.long
@pytest.mark.parametrize("indexed", [False, True])
@pytest.mark.parametrize("seed", few_of(range(15), 2))
def test_a_window_has_the_lines_of_the_whole(tmp_path: Path, seed: int, indexed: bool) -> None:
    recorded(tmp_path, format="4", first_cycle_epoch_ns="100000000000")
    drawn_log(tmp_path, seed)
    if indexed:
        written_by_a_recorder(tmp_path, seed)
    whole, dice = hil_trace(str(tmp_path)), random.Random(-seed)
    times = [entry["at_s"] for entry in whole]
    for _ in range(4):
        begin, end = sorted(dice.choice(times) + dice.choice([0, 0, -1.5e-3, 0.3]) for _ in range(2))
        for low, high in ((begin, None), (None, end), (begin, end)):
            options = [] if low is None else ["--from", repr(low)]
            options += [] if high is None else ["--to", repr(high)]
            expected = [
                entry
                for entry in whole
                if (low is None or entry["at_s"] >= low) and (high is None or entry["at_s"] <= high)
            ]
            assert hil_trace(str(tmp_path), *options) == expected
