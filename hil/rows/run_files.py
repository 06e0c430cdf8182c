"""Names, format and time origin of the files in a run's folder."""

from pathlib import Path
from typing import Final

from servobench.drivers.errors import MISSING, BadInput

FORMAT: Final = "7"
"""Version of the run's folder in docs/recording.md; increases when a reader must know. Up to 3 a recording
has no seal, up to 4 its frames are text, up to 5 its injected faults, up to 6 its columns stand all for
themselves."""
UNSEALED_FORMAT_MAX: Final = 3

FIRST_CYCLE = "first_cycle_bench_ns"
"""Key of the first cycle's instant on the bench clock, from which all times count."""
BENCH_START = "bench_start_ns"
"""Start of the recording in run time."""
FIRST_CYCLE_EPOCH = "first_cycle_epoch_ns"
"""The same in ns since 1970: origin of the stamps of frames."""

BENCH_FILE = "bench.toml"
"""The bench as it was run."""
FRAMES_FILE = "frames.arrow"
"""Every frame, by column and in order of time; see :mod:`servobench.hil.rows.frames_file`."""
FRAMES_LOG = "frames.log"
"""The same up to format 4, in candump's format."""
DIRECTIONS_FILE = "frames.directions"
"""A line for each of frames.log: T sent by the bench, R received by it."""
DIRECTION_BYTES = 2
"""Bytes of such a line."""
INDEX_FILE = "frames.index"
"""Index of the frames on which others depend; see :mod:`servobench.hil.rows.frames_file`."""
FAULTS_FILE = "faults.arrow"
"""What was injected, by column; see :mod:`servobench.hil.rows.faults_file`."""
FAULTS_LOG = "faults.jsonl"
"""The same up to format 5, a line each."""
EVENTS_FILE = "events.jsonl"
RECORDS_FILE = "records.arrow"
"""The rows of the cycles."""
LOAD_FILE = "load.csv"
"""Measurements of a load machine."""
CAMPAIGN_PAGE = "campaign.rrd"
"""In a campaign's folder, by ``hil campaign report``."""
COMMISSIONING_RECORDING = "recording"
"""In a commissioning's folder: its frames and events. Beside bench.toml they would look like a run."""
COMMISSIONING_FIGURES = "figures.json"
"""In that folder: the results of each step."""
COMMISSIONED_FILE = "drive.toml"
"""In that folder: the drive as found, for a bench to name."""
SUMMARY_FILE = "summary.json"
PRINTED_FILE = "printed.txt"
"""Output of the user's code, by the parent of ``hil run``; missing if there was none."""
RERUN_FILE = "run.rrd"
SEAL_FILE = "seal"
"""Digests of all of them; see :mod:`servobench.hil.rows.seal`."""
LOGGER_LOG = "logger.log"
"""The logger's standard error."""
RESERVE_FILE = ".reserve"
"""Disk space reserved for the end; locked by the recorder."""


def not_a_recording(folder: Path, lacks: str) -> BadInput:
    """Return the error for a folder without the file ``lacks`` of a recording."""
    if not folder.exists():
        return BadInput(str(folder), "", MISSING, "the folder of a recording", "hil runs DIR lists them")
    found = f"no {lacks}" if folder.is_dir() else "a file"
    return BadInput(str(folder), "", found, "the folder of a recording", "hil runs DIR lists them")
