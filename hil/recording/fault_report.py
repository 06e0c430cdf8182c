"""``fault.txt`` in the folder of a run that bus or drive ended: the error, the EMCYs, and the last frames."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from servobench.drivers.canopen.cob_ids import frame_name
from servobench.drivers.canopen.nmt import Emergency, EmergencySeries, condensed
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.drivers.wire.frame_port import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_ID_MAX, REMOTE_FLAG
from servobench.hil.recording.sealer import Sealer
from servobench.hil.rows.run_files import FRAMES_FILE, SEAL_FILE

FAULT_FILE = "fault.txt"
FRAMES_MAX = 300
EMERGENCIES_MAX = 50

Make = tuple[int, str]
"""Vendor-ID and device name."""


def write_fault_report(
    folder: Path, error: str, emergencies: Iterable[Emergency], makes: Mapping[int, Make], ended_at: Instant
) -> None:
    """Write it beside the other files of a run whose recording is closed; a full disk is borne.

    ``makes``: of the nodes that told theirs, so that their EMCYs are in their maker's words.
    """
    lines = ["What ended the run:", *(f"  {line}" for line in error.splitlines()), ""]
    told = condensed(emergencies)[-EMERGENCIES_MAX:]
    lines += [
        "EMCYs, the last ones of each code, in ms before the end:",
        *(_emergency(each, makes, ended_at) for each in told),
    ]
    lines += [] if told else ["  none"]
    frames = last_frames(folder)
    lines += ["", f"The last {len(frames)} frames, in ms before the last:", *frames]
    with suppress(OSError, BadInput):
        (folder / FAULT_FILE).write_text("\n".join(lines) + "\n", encoding="utf-8")
        if (folder / SEAL_FILE).exists():
            Sealer(folder, fresh=False).finish()


def _emergency(each: EmergencySeries, makes: Mapping[int, Make], ended_at: Instant) -> str:
    last = each.last
    before_ms, first_ms = (ended_at - last.at) / NS_PER_MS, (ended_at - each.first.at) / NS_PER_MS
    times = f", {each.times} times since {first_ms:.3f}" if each.times > 1 else ""
    return f"  {before_ms:10.3f}  node {last.node_id}: {last.told(*makes.get(last.node_id, (0, '')))}{times}"


def last_frames(folder: Path, count: int = FRAMES_MAX) -> list[str]:
    """The last frames of a recording, each with its name; empty if there are none."""
    from servobench.hil.rows.frames_file import (
        indexed_batches,
        read_batches,  # pyarrow, which no loop needs
        read_index,
    )

    lying = indexed_batches(read_index(folder))
    begin = 0
    if lying.size:
        first = int(np.searchsorted(lying["number"], lying["number"][-1] - count, side="right")) - 1
        begin = int(lying["begin"][max(0, first)])
    try:
        frames = np.concatenate([batch.frames for batch in read_batches(folder / FRAMES_FILE, begin)])
    except (OSError, BadInput, ValueError):
        return []
    return [_frame(row, int(frames["at"][-1])) for row in frames[-count:]]


def _frame(row: np.void, end_ns: int) -> str:
    can_id, digits = int(row["can_id"]), 8 if row["can_id"] & EXTENDED_FLAG else 3
    data = b"" if can_id & REMOTE_FLAG else row["data"].tobytes()[: row["length"]]
    can_id &= EXTENDED_ID_MAX | ERROR_FLAG
    text = f"{can_id:0{digits}X}#{data.hex().upper():<16}"
    return f"  {(end_ns - int(row['at'])) / NS_PER_MS:10.3f}  {text}  {frame_name(can_id, data)}"
