"""A disk of a few bytes that only this process and those that it forks can see."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import copytree
from typing import Final

_NEW_MOUNTS: Final = 0x0002_0000
_NEW_USER: Final = 0x1000_0000
_PRIVATE: Final = 0x4_4000
"""CLONE_NEWNS, CLONE_NEWUSER of sched.h; MS_REC | MS_PRIVATE of sys/mount.h."""


class NoSmallDisk(Exception):
    """The kernel does not let this user have one."""


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """An empty disk of ``size`` bytes; what is on it at the end is copied to ``folder``."""
    disk = folder.with_name(f"{folder.name}-disk")
    disk.mkdir()
    _own_namespace()
    _mount(b"tmpfs", disk, b"tmpfs", 0, f"size={size}".encode())
    yield disk
    copytree(disk, folder, dirs_exist_ok=True)


def _own_namespace() -> None:
    user, group = os.getuid(), os.getgid()
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_NEW_MOUNTS | _NEW_USER):
        raise NoSmallDisk(os.strerror(ctypes.get_errno()))
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/uid_map").write_text(f"0 {user} 1")
    Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    _mount(b"none", Path("/"), None, _PRIVATE, None)


def _mount(source: bytes, target: Path, kind: bytes | None, flags: int, options: bytes | None) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mount(source, os.fsencode(target), kind, flags, options):
        raise NoSmallDisk(os.strerror(ctypes.get_errno()))
