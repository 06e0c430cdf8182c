"""Frames of recordings for tests, as text in candump's form, and their injected faults as objects."""

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from servobench.hil.recording.frame_files import FrameFiles
from servobench.hil.reviewing.export_format import ExportFormat
from servobench.hil.reviewing.frames_export import export_frames
from servobench.hil.reviewing.trace.log_lines import frame_of_line
from servobench.hil.rows.faults_file import read_entries
from servobench.hil.rows.frames_file import read_batches
from servobench.hil.rows.run_files import FAULTS_FILE, FRAMES_FILE
from servobench.hil.rows.side_rows import FRAME_DTYPE, frame_row
from servobench.virtual_bus.faults.fault_log import entries_of, entry_line


def candump(folder: Path) -> Path:
    """The frames of a recording as a log of candump, elsewhere."""
    path = Path(tempfile.mkdtemp()) / "frames.log"
    export_frames(folder, ExportFormat.LOG, path)
    return path


def candump_text(folder: Path) -> str:
    """The same, its content."""
    return candump(folder).read_text()


def injected(folder: Path) -> list[dict[str, Any]]:
    """The injected faults of a recording that may lack its end, as their lines tell them."""
    entries = [each for batch in read_entries(folder / FAULTS_FILE) for each in entries_of(batch.tobytes())]
    return [json.loads(entry_line(entry)) for entry in entries]


def directions(folder: Path) -> list[str]:
    """T or R of each frame."""
    return [
        "T" if sent & 1 else "R"
        for batch in read_batches(folder / FRAMES_FILE)
        for sent in batch.frames["sent"].tolist()
    ]


def write_frames(folder: Path, log: str, sent: str = "") -> None:
    """The frames of candump's lines as those of a recording; ``sent``: T or R of each, default R."""
    frames = [
        frame
        for number, line in enumerate(log.splitlines())
        if (frame := frame_of_line(line.encode(), number))
    ]
    interfaces = tuple(dict.fromkeys(frame.channel for frame in frames))
    rows = []
    for frame, way in zip(frames, sent or "R" * len(frames), strict=True):
        flags = (EXTENDED_FLAG if frame.extended or frame.error else 0) | (REMOTE_FLAG if frame.remote else 0)
        flags |= ERROR_FLAG if frame.error else 0
        segment = interfaces.index(frame.channel)
        rows.append(
            frame_row(
                Instant(frame.at_ns or 0), frame.can_id | flags, segment << 1 | (way == "T"), frame.data
            )
        )
    files = FrameFiles(folder, interfaces or ("can0",))
    files.write(np.frombuffer(b"".join(rows), FRAME_DTYPE), Duration(0))
    files.close()
