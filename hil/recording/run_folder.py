"""What the files in a run's folder are called, and the room on the disk that is kept for its end."""

import fcntl
import json
import os
from pathlib import Path

from hil.verdict.summary import Summary

BENCH_FILE = "bench.toml"
"""The bench as it was run."""
FRAMES_FILE = "frames.log"
"""Every frame, in candump's format and in order of time."""
DIRECTIONS_FILE = "frames.directions"
"""A line for each of frames.log: T was sent by the bench, R was received by it."""
EVENTS_FILE = "events.jsonl"
LOAD_FILE = "load.csv"
"""What a load machine measured."""
SUMMARY_FILE = "summary.json"
LOGGER_LOG = "logger.log"
"""What the logger said on its standard error."""

_RESERVE_FILE = ".reserve"
_RESERVE_BYTES = 256 * 1024
"""Given back at the end: network.toml has 5 kB, fault.txt 30, the end of records.arrow 86 for each hour."""
_SUMMARY_BYTES = 32 * 1024
"""summary.json has 3 kB, and a kilobyte for each step of a load machine."""


class Reserve:
    """Room on the disk that the recording itself cannot fill. Who holds it is the one who records."""

    def __init__(self, folder: Path) -> None:
        """Error: OSError if there is no such room; BlockingIOError if somebody records into the folder."""
        self._path = folder / _RESERVE_FILE
        self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.posix_fallocate(self._descriptor, 0, _RESERVE_BYTES)
        except BlockingIOError:
            os.close(self._descriptor)
            raise
        except OSError:
            self.close()
            raise

    def release(self) -> None:
        """The room is there for the end of the other files now; what the summary needs stays kept."""
        os.ftruncate(self._descriptor, _SUMMARY_BYTES)

    def close(self) -> None:
        """Nobody records here any more, or all but the summary is written."""
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)


def write_summary(folder: Path, summary: Summary) -> None:
    """summary.json, which is either there as a whole or not at all. Error: OSError."""
    text = json.dumps(summary.as_json(), indent=2) + "\n"
    part = folder / f"{SUMMARY_FILE}.part"
    try:
        part.write_text(text)
        part.replace(folder / SUMMARY_FILE)
    except OSError:
        part.unlink(missing_ok=True)
        raise
