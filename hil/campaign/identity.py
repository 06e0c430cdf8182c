"""Content on which the rows of a campaign depend: its sweep, every file that a run opened, the program.

    {"sweep": BLAKE2b of the sweep,
     "program": {"servobench": version, "source": BLAKE2b, "commit": ..., "python": ...,
                 PACKAGE: version, ...},
     "files": {path from the folder of the sweep file on: BLAKE2b}}

All of it is the same from any working directory, and in a tree that was moved as a whole. The files that the
calling thread opens to read are noted by Python's audit hook (PEP 578), digested before reading and again
after: an edit meanwhile is noticed. A file that compiled code opens by itself, past Python, is not seen.
"""

import os
import platform
import re
import site
import stat
import sys
import sysconfig
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from servobench.drivers.errors import BadInput
from servobench.hil.recording.run_metadata import source_commit

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
        if importing or path in map(os.path.realpath, sys.path):  # it looks in many places
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


Identity = dict[str, Any]
"""Plain values, as above."""
_RESTORE: Final = "restore it, or begin a campaign in a folder of its own with --out"
_NAME: Final = re.compile(r"[A-Za-z0-9._-]+")


class SourceFiles:
    """The files opened by the runs of a campaign: each has one content in all of its runs."""

    def __init__(self, sweep: Path, digests: Mapping[str, str] | None = None) -> None:
        """``sweep``: the sweep file; ``digests``: those already stored in the campaign."""
        self._folder = os.path.realpath(sweep.parent)
        self.digests = dict(digests or {})
        """Digests by path relative to the folder of the sweep."""
        self._fresh: dict[str, str] = {}

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Note the files opened inside. Raises BadInput for a file that has changed."""
        with opened_files() as opened:
            yield
        self.meet({os.path.relpath(path, self._folder): digest for path, digest in opened.digests.items()})
        for path, before, now in opened.changed():
            raise _changed(path, now, before)

    def meet(self, digests: Mapping[str, str]) -> None:
        """Take in files opened by others. Raises BadInput for one with other contents here."""
        for name, digest in digests.items():
            known = self.digests.get(name)
            if known is None:
                self.digests[name] = self._fresh[name] = digest
            elif known != digest:
                raise _changed(self._path(name), digest, known)

    def fresh(self) -> dict[str, str]:
        """Return files noted since the last call."""
        fresh, self._fresh = self._fresh, {}
        return fresh

    def require(self, digests: Mapping[str, str]) -> None:
        """Resume a campaign with these files. Raises BadInput for the first that has changed."""
        for name, digest in digests.items():
            now = self.digests.get(name) or digest_of(self._path(name))
            if now != digest:
                raise _changed(self._path(name), now, digest)
        self.meet(digests)

    def _path(self, name: str) -> str:
        return os.path.normpath(os.path.join(self._folder, name))


def _changed(path: str, now: str, before: str) -> BadInput:
    def shown(digest: str) -> str:
        return digest if digest == ABSENT else f"BLAKE2b {digest}"

    return BadInput(path, "", shown(now), f"{shown(before)}, as other runs of the campaign met it", _RESTORE)


@cache
def program() -> dict[str, str]:
    """Identify the program: servobench by content, its required packages by version."""
    digest = blake2b(digest_size=DIGEST_BYTES)
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*")):
            if path.suffix in (".py", ".toml", ".c", ".h") and path.is_file():
                digest.update(f"{path.relative_to(ROOT)}\0".encode())
                digest.update(path.read_bytes())
    told = {"source": digest.hexdigest(), "commit": source_commit(), "python": platform.python_version()}
    waiting = ["servobench"]
    while waiting:
        name = re.sub(r"[-_.]+", "-", waiting.pop()).lower()
        if name in told:
            continue
        try:
            told[name] = version(name)
        except PackageNotFoundError:
            continue
        wanted = requires(name) or ()  # of its own extras too, as far as they are there
        needed = [each for each in wanted if name == "servobench" or "extra ==" not in each]
        waiting += [match[0] for each in needed if (match := _NAME.match(each))]
    return told


def require_program(before: Mapping[str, str], source: str) -> None:
    """Raise BadInput for another program than that of the campaign in the file ``source``."""
    now = program()
    for name in sorted((before.keys() | now.keys()) - {"commit"}):
        if before.get(name) == now.get(name):
            continue
        commits = f"; commit {before.get('commit')}, now {now['commit']}" if name == "source" else ""
        expected = f"{now.get(name, 'none')}, which is what runs here"
        raise BadInput(
            source, f"identity.program.{name}", before.get(name, "none"), expected + commits,
            "rows of two programs make no table: take that one, or a folder of its own with --out",
        )  # fmt: skip
