"""Where a hub lives: a socket, a lock and a log in a directory that belongs to one user."""

import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import can

from servobench.drivers.timebase import NS_PER_MS, Clock, Duration, Instant
from servobench.drivers.wire.adapters import HUB_NAME, HUB_NAME_EXPECTED

_SOCKET_PATH_BYTES_MAX = 107
_LOCK_RETRY_NS = 5 * NS_PER_MS
"""``flock`` knows no time-out, so it is asked again: soon, beside the second in which a broker starts."""


def checked_name(name: str) -> str:
    """``name`` if it can name a hub; raises can.CanInitializationError otherwise."""
    if HUB_NAME.fullmatch(name) is None:
        raise can.CanInitializationError(f"hub name {name!r}: expected {HUB_NAME_EXPECTED}")
    return name


def runtime_directory() -> Path:
    """The user's own directory for hubs, made on demand with mode 0700.

    Raises can.CanInitializationError if it belongs to somebody else or is open to others:
    in a directory shared by all users, another one could have put a socket of his there.
    """
    base = Path(os.environ.get("XDG_RUNTIME_DIR", ""))
    user = os.getuid()
    usable = base.is_absolute() and base.is_dir() and base.stat().st_uid == user
    directory = base / "servobench" if usable else Path(f"/tmp/servobench-{user}")
    try:
        with suppress(FileExistsError):  # raised for a file of that name only, which is refused below
            directory.mkdir(mode=0o700, exist_ok=True)
        status = directory.lstat()
    except OSError as error:
        raise can.CanInitializationError(f"{directory} cannot be made: {error.strerror}") from error
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != user or status.st_mode & 0o077:
        raise can.CanInitializationError(
            f"{directory}: expected a directory of user {user} with mode 0700;"
            " remove it, or set XDG_RUNTIME_DIR"
        )
    return directory


def try_lock(path: Path) -> int | None:
    """Take the lock on ``path``: a descriptor whose closing frees it, or None if somebody holds it.

    The kernel frees it when its holder dies, however that happens. Who holds it may remove the file.
    """
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        if _is_at(path, descriptor):
            return descriptor
        os.close(descriptor)  # it was removed after it was opened here: a lock on it keeps nobody out


def _is_at(path: Path, descriptor: int) -> bool:
    """Return True if the open file is the one that ``path`` names now."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


class HubPlace:
    """The files of the hub ``name``."""

    def __init__(self, name: str) -> None:
        directory = runtime_directory()
        self.name = checked_name(name)
        self.socket = directory / f"{name}.sock"
        self.lock = directory / f"{name}.lock"
        """Held by whoever starts or ends the hub, for as long as that takes."""
        self.alive = directory / f"{name}.alive"
        """Held by the hub's broker while it serves; it holds the broker's process id."""
        self.log = directory / f"{name}.log"
        if len(os.fsencode(self.socket)) > _SOCKET_PATH_BYTES_MAX:
            raise can.CanInitializationError(f"{self.socket}: too long for a socket; set XDG_RUNTIME_DIR")

    def clear(self) -> None:
        """Remove what a hub leaves but a log with text in it, under its lock, which goes last.

        From then on another process may start the hub anew.
        """
        self.socket.unlink(missing_ok=True)
        self.alive.unlink(missing_ok=True)
        if self.log.exists() and not self.log.stat().st_size:
            self.log.unlink()
        self.lock.unlink(missing_ok=True)

    @property
    def serving(self) -> bool:
        """True if a broker is running: a killed one leaves its files, but not its lock."""
        if not self.alive.exists():
            return False
        descriptor = try_lock(self.alive)
        if descriptor is not None:
            os.close(descriptor)
        return descriptor is None

    @contextmanager
    def locked(self, clock: Clock, patience: Duration) -> Iterator[None]:
        """Hold the lock; raises can.CanInitializationError if another process keeps it for too long."""
        deadline = clock.now() + patience
        while (descriptor := try_lock(self.lock)) is None:
            if clock.now() >= deadline:
                raise can.CanInitializationError(
                    f"hub {self.name!r}: another process keeps {self.lock} locked"
                )
            clock.sleep_until(Instant(clock.now() + _LOCK_RETRY_NS))
        try:
            yield
        finally:
            if not self.serving:
                self.clear()
            os.close(descriptor)


def known_hubs() -> list[str]:
    """Names of the hubs that have a socket: those running, and those that were killed.

    None where the folder of hubs cannot be used; why, joining one says.
    """
    try:
        directory = runtime_directory()
    except can.CanInitializationError:
        return []
    return sorted(path.stem for path in directory.glob("*.sock"))
