"""The room on the disk that is kept for the end of a recording, and its summary."""

import fcntl
import json
import os
from pathlib import Path
from typing import Final

from servobench.drivers.bounded_file import parse_json, read_text
from servobench.drivers.errors import BadInput
from servobench.hil.rows.run_files import RESERVE_FILE, SUMMARY_FILE
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary

_RESERVE_BYTES = 256 * 1024
"""Given back at the end: network.toml has 5 kB, fault.txt 30, the end of records.arrow 86 for each hour."""
_SUMMARY_BYTES = 32 * 1024
"""summary.json has 3 kB, and a kilobyte for each step of a load machine."""
_WHOLE = "a whole summary"
_FORMERLY: Final = {"delay_us": "reading_delay_us", "losses_in_a_row": "reading_losses_in_a_row"}
"""Keys of older recordings that have another name now."""


class Reserve:
    """Room on the disk that the recording itself cannot fill. Who holds it is the one who records."""

    def __init__(self, folder: Path) -> None:
        """Error: OSError if there is no such room; BlockingIOError if somebody records into the folder."""
        self._path = folder / RESERVE_FILE
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


def read_summary(folder: Path) -> Summary:
    """Read the summary of the run in ``folder``. Raises BadInput, and of it NoSuchFile."""
    path = folder / SUMMARY_FILE
    plain = parse_json(read_text(path, "summary"), str(path), _WHOLE)
    if isinstance(plain, dict):
        plain = {_FORMERLY.get(key, key): value for key, value in plain.items()}
    try:
        return from_plain(Summary, plain)
    except ValueError as error:
        raise BadInput(str(path), "", str(error), _WHOLE) from None
