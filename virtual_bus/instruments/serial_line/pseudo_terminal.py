"""A pseudo-terminal with a simulated serial device at it, as a USB adapter is at /dev/ttyACM0."""

import errno
import os
import tty
from contextlib import suppress
from pathlib import Path

from servobench.drivers.errors import BadInput
from servobench.drivers.wire.serial_line import READ_BYTES


class PseudoTerminal:
    """The device's end; the other end is opened by its ``path``, or by the name of ``link``."""

    def __init__(self, link: Path | None = None) -> None:
        """``link``: a symbolic link to make, which stays the same from run to run.

        Raises BadInput if something else has that name.
        """
        self._master, self._slave = os.openpty()
        # Without an open slave the master reads an error until somebody opens it, and no settings would last.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._link = link
        self.plugged = True
        if link is not None:
            try:
                self._make_link(link)
            except BaseException:
                self._link = None
                self.unplug()
                raise

    @property
    def name(self) -> str:
        """The name to open: the link if there is one."""
        return str(self._link) if self._link is not None else self.path

    def fileno(self) -> int:
        """For select."""
        return self._master

    def read(self, limit: int = READ_BYTES) -> bytes:
        """Return data from the other end, at most ``limit`` bytes; empty if there is none, or if
        unplugged."""
        if not self.plugged:
            return b""
        try:
            return os.read(self._master, limit)
        except BlockingIOError:
            return b""
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return b""

    def write(self, data: bytes) -> int:
        """Send as much of ``data`` as the line has room for; how many bytes that was."""
        if not self.plugged:
            return len(data)
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def unplug(self) -> None:
        """Close the line: the other end finds its port gone. The link goes too."""
        if not self.plugged:
            return
        self.plugged = False
        os.close(self._master)
        os.close(self._slave)
        link = self._link
        if link is not None and link.is_symlink() and os.readlink(link) == self.path:
            with suppress(FileNotFoundError):
                link.unlink()

    def _make_link(self, link: Path) -> None:
        if link.is_symlink():
            link.unlink()
        try:
            link.symlink_to(self.path)
        except OSError as error:
            raise BadInput(
                "--link", "", str(link), "a name for a new symbolic link", error.strerror or str(error)
            ) from error
