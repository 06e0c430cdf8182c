"""Notes the files that the calling thread opens to read, with their contents: by Python's audit hook (PEP
578).

Contents are digested before reading and again after: an edit meanwhile is noticed. A file that compiled code
opens by itself, past Python, is not seen.
"""

import os
import site
import stat
import sys
import sysconfig
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from hashlib import blake2b
from pathlib import Path
from types import ModuleType
from typing import Any, Final

DIGEST_BYTES: Final = 16
"""128 bits: of 2^64 files two are alike by chance."""
ABSENT: Final = "no file"
"""In place of a digest: the file was looked for and missing."""
ROOMS: Final = ("drivers", "virtual_bus", "design", "hil")
"""The packages of the program; beside each other."""
ROOT: Final = Path(__file__).parents[2]
_SYSTEM: Final = ("/proc", "/sys", "/dev", "/run", "/etc", "/lib", "/usr/lib", "/usr/share")
"""Paths of the machine: its processor, clock and time zones are in no campaign's identity."""
_USERS_THERE: Final = ("/dev/shm/", "/run/media/", "/run/user/")
"""Folders of users in these: in memory, on a drive that was plugged in, of a session."""
_IMPORTER: Final = "<frozen "
"""Prefix of file names of Python's own importers."""
_BLOCK_BYTES: Final = 1 << 20
_WRITES: Final = os.O_WRONLY | os.O_RDWR


class Opened:
    """Files opened by one thread within :func:`opened_files`."""

    def __init__(self) -> None:
        self.digests: dict[str, str] = {}
        """BLAKE2b by real path, when the file was first opened; :data:`ABSENT`."""
        self.written: set[str] = set()
        """Real paths opened for writing: products, not sources."""

    def changed(self) -> Iterator[tuple[str, str, str]]:
        """Yield path, digest when opened, and digest now, of each file edited since."""
        for path, digest in self.digests.items():
            if (now := digest_of(path)) != digest:
                yield path, digest, now


_noting: dict[int, Opened] = {}
"""By thread."""
_modules: dict[str, str] = {}
"""Digests of user modules imported within :func:`opened_files`, at that time: a process does not read them
again. They count wherever a file beside or above them is opened."""


@contextmanager
def opened_files() -> Iterator[Opened]:
    """Note the files that this thread opens inside, and the user modules imported."""
    _install()
    thread, opened = threading.get_ident(), Opened()
    before = set(sys.modules)
    outer = _noting.get(thread)
    _noting[thread] = opened
    try:
        yield opened
    finally:
        del _noting[thread]
        if outer is not None:
            _noting[thread] = outer
    for name in sys.modules.keys() - before:
        file = _file_of(sys.modules[name])
        if file and file not in opened.digests and _is_users(file, imported=True):
            _modules.setdefault(file, digest_of(file))
    folders = {os.path.dirname(path) + os.sep for path in opened.digests}
    beside = {path: digest for path, digest in _modules.items() if any(map(path.startswith, folders))}
    opened.digests = {**beside, **opened.digests}
    for path in opened.written:
        opened.digests.pop(path, None)


def digest_of(path: str) -> str:
    """Return the BLAKE2b of a file's content, 128 bit, hex; :data:`ABSENT`. Error: OSError: it cannot be
    read."""
    digest = blake2b(digest_size=DIGEST_BYTES)
    try:
        with open(path, "rb") as file:
            while block := file.read(_BLOCK_BYTES):
                digest.update(block)
    except (FileNotFoundError, NotADirectoryError):
        return ABSENT
    return digest.hexdigest()


@cache
def _install() -> None:
    """Install the hook, once per process: it cannot be removed."""
    sys.addaudithook(_hear)


def _hear(event: str, args: tuple[Any, ...]) -> None:
    if event != "open" or not _noting:
        return
    thread = threading.get_ident()
    opened = _noting.pop(thread, None)  # what is opened here is no part of it
    if opened is None:
        return
    try:
        path, _, flags = args
        if not isinstance(path, int):
            _note(opened, os.path.realpath(os.fsdecode(path)), flags)
    except (OSError, TypeError, ValueError):
        """Whoever opens it is told."""
    finally:
        _noting[thread] = opened


def _note(opened: Opened, path: str, flags: int) -> None:
    importing = sys._getframe(2).f_code.co_filename.startswith(_IMPORTER)
    if path in opened.digests or not _is_users(path, importing):
        return
    if flags & _WRITES:
        opened.written.add(path)
        return
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            return
    except (FileNotFoundError, NotADirectoryError):
        if importing or path in sys.path:  # it looks in many places
            return
    opened.digests[path] = digest_of(path)


def _is_users(path: str, imported: bool) -> bool:
    """Return True for a file of the user's: not of the program, its packages or the system, and no cache."""
    if path.endswith(".pyc") or f"{os.sep}__pycache__{os.sep}" in path:
        return False
    packages, others = _not_the_users()
    if path.startswith(_USERS_THERE):
        return True
    if path.startswith(packages):
        return path.endswith(".py") and not imported  # a package of the user's is read as a source, too
    return not path.startswith(others)


@cache
def _not_the_users() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return folders of installed packages, and other excluded ones, each with the separator at its end."""
    paths = sysconfig.get_paths()
    packages = {paths["purelib"], paths["platlib"], site.getusersitepackages(), *site.getsitepackages()}
    home = os.path.expanduser("~")
    caches = {
        os.environ.get("XDG_CACHE_HOME") or os.path.join(home, ".cache"),
        *filter(None, [os.environ.get("MPLCONFIGDIR")]),
    }
    rooms = {str(ROOT / room) for room in ROOMS}
    others = {paths["stdlib"], paths["platstdlib"], *_SYSTEM, *caches, *rooms}

    def folders(names: set[str]) -> tuple[str, ...]:
        return tuple(os.path.realpath(name) + os.sep for name in sorted(names))

    return folders(packages), folders(others)


def _file_of(module: ModuleType) -> str:
    file = getattr(module, "__file__", None)
    return os.path.realpath(file) if isinstance(file, str) and os.path.isfile(file) else ""
