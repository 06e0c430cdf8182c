"""What it takes to read a recording again: hil export and hil trace, time and memory.

Ten minutes of three axes at 1 kHz, made up; each command is a process of its own. The figures are the
processor time for an hour of recording (trace: for a million frames) and the largest resident set, which is
never told smaller than that of this process at the fork.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from servobench.drivers.timebase import NS_PER_US, Instant
from servobench.hil.loop.cycle_record import COLUMNS, NOTHING
from servobench.hil.recording.sealer import Sealer
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.records_file import RecordsWriter
from servobench.hil.rows.run_files import RECORDS_FILE

_SECONDS, _AXES = 600, 3
_FRAMES = 300_000
_LOSS = 0.02


def main() -> None:
    """Print a table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write_records(folder)
        _write_log(folder / "bus.log")
        print(f"{'':20} {'s':>10} {'MB':>8}")
        for ending in ("parquet", "csv", "mat", "mf4"):
            seconds, megabytes = _cost("export", str(folder), "--to", ending)
            (folder / f"records.{ending}").unlink(missing_ok=True)
            print(f"{f'export {ending}':20} {seconds * 3600 / _SECONDS:10.1f} {megabytes:8.0f}   an hour")
        seconds, megabytes = _cost("trace", str(folder / "bus.log"), "--json")
        print(f"{'trace':20} {seconds * 1e6 / _FRAMES:10.1f} {megabytes:8.0f}   a million frames")


def _write_records(folder: Path) -> None:
    writer, random = RecordsWriter(folder / RECORDS_FILE), np.random.default_rng(1)
    writer.begin({"axes": json.dumps([f"axis{number}" for number in range(_AXES)])}, Instant(0))
    for second in range(_SECONDS):
        writer.write(_rows(second, random))
    writer.close()
    Sealer(folder).finish()


def _rows(second: int, random: np.random.Generator) -> Rows:
    """A second of all axes; noise, which packs worse than what a drive tells."""
    rows = np.zeros(1000 * _AXES, ROW_DTYPE)
    cycle = np.repeat(np.arange(second * 1000, second * 1000 + 1000), _AXES)
    for column in COLUMNS:
        if column.name.startswith("channel_"):
            rows[column.name] = np.nan
        elif column.kind == "float64":
            rows[column.name] = random.normal(size=rows.size)
        elif column.is_instant:
            rows[column.name] = cycle * 1000 * NS_PER_US + random.integers(0, 900 * NS_PER_US, rows.size)
    rows["sequence"], rows["axis"] = cycle + 1, np.tile(np.arange(_AXES), 1000)
    rows["due_at"] = cycle * 1000 * NS_PER_US
    lost = random.random(rows.size) < _LOSS
    rows["fate"], rows["sampled_at"] = lost, np.where(lost, NOTHING, rows["sampled_at"])
    rows["velocity_rad_s"][lost] = np.nan
    return rows


def _write_log(path: Path) -> None:
    """SYNC, a TPDO whose mapping is told, a heartbeat now and then."""
    mapping = ("2F001A0000000000", "23001A0110004160", "23001A0220006C60", "2F001A0002000000")
    lines = [line for text in mapping for line in (f"601#{text}", f"581#60{text[2:8]}00000000")]
    while len(lines) < _FRAMES:
        lines += ["080#", f"181#3712{len(lines):08X}", f"701#{5:02X}"]
    with path.open("w") as file:
        for number, line in enumerate(lines[:_FRAMES]):
            file.write(f"({1_700_000_000 + number // 1000:010d}.{number % 1000:03d}000) can0 {line}\n")


def _cost(*arguments: str) -> tuple[float, float]:
    """Processor time, s, and largest resident set, MB; NaN where the command cannot (mf4 without asammdf)."""
    command = [sys.executable, "-m", "servobench.hil.cli", *arguments]
    started = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(started.pid, 0)
    started.returncode = os.waitstatus_to_exitcode(status)
    if started.returncode:
        return float("nan"), float("nan")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


if __name__ == "__main__":
    main()
