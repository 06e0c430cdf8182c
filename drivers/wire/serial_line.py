"""A serial port as a stream of bytes that never makes its caller wait.

pyserial opens the port and sets its line up; reading and writing go to its descriptor, because pyserial's own
``read`` and ``write`` wait for time-outs that are the same for every call. A port that is gone (unplugged, or
the other end of a pseudo-terminal closed) is an error at the next call, never silence.
"""

import os
import select
import termios
from collections import deque
from typing import Final, Protocol

import serial

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_S, Clock, Instant

BITS_A_BYTE: Final = 10
"""A start bit, eight of data, a stop bit."""
READ_BYTES: Final = 4096
"""Linux's limit for a terminal's input (N_TTY_BUF_SIZE)."""
HELD_BYTES_MAX = 4096
"""Bytes waiting for the port; a line of 115200 baud needs a third of a second for them."""


class LineGone(OSError):
    """The serial port went away."""


class LineFull(OSError):
    """The port takes no more bytes: its other end stands still."""


class ByteLine(Protocol):
    """The port of a serial instrument, as its driver sees it."""

    name: str

    def read(self) -> bytes:
        """Return the bytes since the last call; empty if there are none. Raises LineGone."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of ``data``, now or as the port takes it. Raises LineGone or LineFull."""
        ...

    def close(self) -> None:
        """Give the port back."""
        ...


class SerialLine:
    """A serial port of this machine, or a pseudo-terminal."""

    def __init__(self, path: str, baud: int) -> None:
        """Eight data bits, no parity, one stop bit; the port is this process's alone.

        Raises OSError (serial.SerialException) if it cannot be opened.
        """
        self.name = path
        # One of pyserial's URLs, e.g. socket://host:port of a serial server, is no file to be locked.
        lock = {} if "://" in path else {"exclusive": True}
        self._port = serial.serial_for_url(path, baud, timeout=0, write_timeout=0, **lock)
        self._descriptor: int = self._port.fileno()
        os.set_blocking(self._descriptor, False)
        if os.isatty(self._descriptor):
            # Without this an empty port and one that is gone would both read as no bytes.
            settings = termios.tcgetattr(self._descriptor)
            settings[6][termios.VMIN] = 1
            termios.tcsetattr(self._descriptor, termios.TCSANOW, settings)
        self._held: deque[bytes] = deque()
        self._held_bytes = 0

    def fileno(self) -> int:
        """Return the descriptor, for select."""
        return self._descriptor

    @property
    def held_bytes(self) -> int:
        """Bytes written that the port has not taken yet."""
        return self._held_bytes

    def read(self) -> bytes:
        """Return received bytes; waiting output is sent first, as far as the port takes it."""
        if self._held:
            self._flush()
        try:
            data = os.read(self._descriptor, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._gone(error) from error
        if not data:
            raise self._gone(None)
        return data

    def write(self, data: bytes) -> None:
        """Send ``data``; what the port does not take at once is held and sent by later calls."""
        if self._held_bytes + len(data) > HELD_BYTES_MAX:
            self._flush()
            if self._held_bytes + len(data) > HELD_BYTES_MAX:
                raise LineFull(f"{self.name} takes no more: {self._held_bytes} bytes wait")
        self._held.append(data)
        self._held_bytes += len(data)
        self._flush()

    def wait(self, until: Instant, clock: Clock) -> None:
        """Return when something has come, when a held write can go on, or at ``until``."""
        wait_s = max(0, until - clock.now()) / NS_PER_S
        select.select([self._descriptor], [self._descriptor] if self._held else [], [], wait_s)

    def close(self) -> None:
        self._held.clear()
        self._held_bytes = 0
        self._port.close()

    def _flush(self) -> None:
        while self._held:
            data = self._held[0]
            try:
                taken = os.write(self._descriptor, data)
            except BlockingIOError:
                return
            except OSError as error:
                raise self._gone(error) from error
            self._held_bytes -= taken
            if taken < len(data):
                self._held[0] = data[taken:]
                return
            self._held.popleft()

    def _gone(self, error: OSError | None) -> LineGone:
        reason = f": {error.strerror}" if error is not None and error.strerror else ""
        return LineGone(f"{self.name} is gone{reason}")


def open_line(path: str, baud: int, what: str) -> SerialLine:
    """Open the port of ``what`` (as an error names it). Raises BusDown with the remedy."""
    try:
        return SerialLine(path, baud)
    except (OSError, ValueError) as error:
        raise BusDown(
            f"cannot open {path}, the port of the {what}",
            str(error),
            "check the port's name, that no other program has it, and that you may open it (group dialout)",
        ) from error
