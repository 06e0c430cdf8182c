"""Writes that are on the disk when a call returns, and not only in the kernel's cache."""

import fcntl
import os
from pathlib import Path
from typing import BinaryIO


def write_synced(file: BinaryIO, data: bytes) -> None:
    """Write ``data`` and wait until the disk has it. Error: OSError."""
    file.write(data)
    file.flush()
    os.fsync(file.fileno())


def is_locked(path: Path) -> bool:
    """Return True if somebody holds the lock (flock) of a file; False for a missing file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the folder's entries, e.g. a new or renamed file. Error: OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
