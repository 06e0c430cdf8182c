"""A folder for a forked process alone."""

import fcntl
import os
from pathlib import Path
from shutil import copytree


def take_a_copy(folder: Path, aside: Path) -> None:
    """Leave ``folder`` to the other process, as ``aside``: the path, and files open below, are a copy's."""
    folder.rename(aside)
    copytree(aside, folder)
    for name in os.listdir("/proc/self/fd"):
        try:
            opened = Path(os.readlink(f"/proc/self/fd/{name}"))
        except FileNotFoundError:  # of the listing itself
            continue
        if opened.is_relative_to(aside):
            one = int(name)
            flags = fcntl.fcntl(one, fcntl.F_GETFL) & (os.O_ACCMODE | os.O_APPEND)
            other = os.open(folder / opened.relative_to(aside), flags)
            os.lseek(other, os.lseek(one, 0, os.SEEK_CUR), os.SEEK_SET)
            os.dup2(other, one)
            os.close(other)
