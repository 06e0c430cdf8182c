"""The one writer for files that a user names: a regular file appears whole or not at all; a device is written
to.

A link is followed. A regular file, or one that is not there yet, is written beside its place and put there by
one rename. What is no regular file (/dev/stdout, /dev/null, a FIFO) gets the content; a folder and a block
device are refused.

Writes that are on the disk when a call returns, and not only in the kernel's cache.
"""

import errno
import fcntl
import itertools
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final

from servobench.drivers.errors import BadInput, BenchError

_DISK_ERRORS: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
_NOT_THE_PLACE: Final = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""Errors of the machine, whatever the file."""
_OPENED_BY_OTHERS: Final = ("/dev/", "/proc/")
"""Names there refer to something already open, say by the shell: creating another file of that name is no
use."""
_number = itertools.count()


class DiskFull(BenchError):
    """The disk is full, or fails."""

    exit_status = 5


@contextmanager
def writing(option: str, path: Path) -> Iterator[None]:
    """Raise BadInput or DiskFull for an OSError inside, where ``path`` is written; ``option`` names it."""
    try:
        yield
    except OSError as error:
        if error.errno in _NOT_THE_PLACE:
            raise
        reason = error.strerror or str(error)
        if error.errno in _DISK_ERRORS:
            raise DiskFull(f"{option}: {path}: {reason}") from None
        raise BadInput(option, "", str(path), "a place to write to", reason) from None


@contextmanager
def written(option: str, path: Path, suffix: str = "") -> Iterator[Path]:
    """Yield the path to write the file of ``option`` to: it becomes ``path`` once complete, or nothing does.

    ``suffix``: suffix of the name to write to, for writers that depend on it; default: that of ``path``.
    Raises BadInput or DiskFull.
    """
    with writing(option, path):
        status = _status(path)
        if status is not None and not stat.S_ISREG(status.st_mode):
            if stat.S_ISBLK(status.st_mode):
                raise BadInput(option, "", str(path), "a file to write to, and no block device")
            if stat.S_ISDIR(status.st_mode):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if status is None or (stat.S_ISREG(status.st_mode) and not _is_held(path)):
            with _beside(path, suffix or path.suffix, status) as part:
                yield part
        else:
            with tempfile.TemporaryDirectory() as folder:
                part = Path(folder) / f"content{suffix or path.suffix}"
                yield part
                _pour(part, path)


def write_file(option: str, path: Path, content: str | bytes) -> None:
    """Write ``content``, text as UTF-8, to the file that ``option`` names. Raises BadInput or DiskFull."""
    with written(option, path) as place:
        place.write_bytes(content.encode() if isinstance(content, str) else content)


def _status(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except FileNotFoundError:
        return None


def _is_held(path: Path) -> bool:
    return os.path.abspath(path).startswith(_OPENED_BY_OTHERS)


@contextmanager
def _beside(path: Path, suffix: str, status: os.stat_result | None) -> Iterator[Path]:
    target = Path(os.path.realpath(path))
    part = target.with_name(f".{os.getpid()}-{next(_number)}.writing{suffix}")
    try:
        yield part
        if status is not None:
            part.chmod(stat.S_IMODE(status.st_mode))
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def _pour(part: Path, path: Path) -> None:
    """Append to ``path``: the shell's ``>`` may hold what was printed before."""
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
    with part.open("rb") as source, open(descriptor, "wb") as sink:
        shutil.copyfileobj(source, sink)


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
