"""``fault.txt`` in the folder of a run that bus or drive ended: the error, the EMCYs, and the last frames."""

import os
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from servobench.drivers.canopen.nmt import Emergency, EmergencySeries, condensed
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.recording.sealer import Sealer
from servobench.hil.rows.frame_names import frame_name
from servobench.hil.rows.run_files import FRAMES_FILE, SEAL_FILE

FAULT_FILE = "fault.txt"
FRAMES_MAX = 300
EMERGENCIES_MAX = 50
_LINE_BYTES_MAX = 320
"""47 and the interface, whose name, of a serial adapter by its ID, may be a path of 18 and 255 letters."""
_FRAME = re.compile(r"^\((\d+\.\d+)\) (\S+) ([0-9A-F]+)#([0-9A-F]*)")

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
    frames = last_frames(folder / FRAMES_FILE)
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


def last_frames(path: Path, count: int = FRAMES_MAX) -> list[str]:
    """The end of a candump file, each frame with its name; empty if there is none."""
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - count * _LINE_BYTES_MAX))
            text = file.read().decode("ascii", errors="replace")
    except OSError:
        return []
    matches = [match for line in text.splitlines() if (match := _FRAME.match(line))][-count:]
    if not matches:
        return []
    end_s = float(matches[-1][1])
    return [_frame(match, end_s) for match in matches]


def _frame(match: re.Match[str], end_s: float) -> str:
    digits = match[4]
    data = bytes.fromhex(digits) if len(digits) % 2 == 0 else b""
    name = frame_name(int(match[3], 16), data)
    return f"  {(end_s - float(match[1])) * 1e3:10.3f}  {match[3]}#{digits:<16}  {name}"
