"""The line between a simulated serial device and its pseudo-terminal: its pace, its bounds, and what goes
wrong on it, drawn from a seed: faults of cables, boards and firmware.

A pseudo-terminal with a simulated serial device at it, as a USB adapter is at /dev/ttyACM0.
"""

import errno
import os
import tty
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from servobench.drivers.errors import BadInput
from servobench.drivers.key_advice import nearest
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, duration_s
from servobench.drivers.wire.serial_line import BITS_A_BYTE, READ_BYTES


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


_PROBABILITIES = ("drop", "garble", "truncate", "noise", "terminator", "refuse", "lose")


@dataclass(frozen=True, slots=True)
class LineFaults:
    """Probabilities are per line (what ends with a terminator) from the device to the host."""

    baud: int = 0
    """Bytes take their time in both directions; 0: as fast as a USB adapter hands them on."""
    drop: float = 0.0
    """The line does not come at all."""
    garble: float = 0.0
    """One byte of it becomes another."""
    truncate: float = 0.0
    """Its end is missing, terminator included."""
    noise: float = 0.0
    """Bytes that mean nothing come before it."""
    terminator: float = 0.0
    """It ends with a line feed instead of its own terminator."""
    lose: float = 0.0
    """A byte of what the host sends gets lost, per piece that the device reads."""
    late_ms: float = 0.0
    """So much later than it could come."""
    unplug_after_s: float = 0.0
    """The device goes away so long after its start; 0: never."""
    refuse: float = 0.0
    """A frame to be sent is refused, as with a full transmit queue; for adapters only."""
    status: int = 0
    """Flags that an adapter tells beside its own when asked for its status."""

    @classmethod
    def parse(cls, entries: list[str], option: str = "--fault") -> "LineFaults":
        """From ``NAME=VALUE`` each. Raises BadInput."""
        known = {field.name: field.type for field in fields(cls)}
        values: dict[str, Any] = {}
        for entry in entries:
            name, sign, text = entry.partition("=")
            if name not in known or not sign:
                near = nearest(name, known)
                remedy = f"did you mean {near}?" if near else f"known are {', '.join(known)}"
                raise BadInput(option, "", entry, "NAME=VALUE of a fault of the line", remedy)
            values[name] = _number(entry, text, known[name] is int, option)
        for name in _PROBABILITIES:
            if not 0.0 <= values.get(name, 0.0) <= 1.0:
                raise BadInput(option, "", f"{name}={values[name]}", "a probability, 0 to 1")
        return cls(**values)

    def time_on_line(self, count: int) -> Duration:
        """How long ``count`` bytes take."""
        return Duration(-(-count * BITS_A_BYTE * NS_PER_S // self.baud) if self.baud else 0)

    def goes_at(self, started_at: Instant) -> Instant | None:
        """When the device goes away; None: never."""
        return Instant(started_at + duration_s(self.unplug_after_s)) if self.unplug_after_s else None


def _number(entry: str, text: str, whole: bool, option: str) -> float:
    try:
        value = int(text, 0) if whole else float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < 1e9:
        raise BadInput(option, "", entry, f"{'a whole number' if whole else 'a number'} not below 0")
    return value


class LineSpoiler:
    """Does to lines what :class:`LineFaults` asks for; every fault has a random stream of its own."""

    def __init__(self, faults: LineFaults, seed: int) -> None:
        self.faults = faults
        self.spoilt = 0
        """Lines that did not go out as they should have."""
        self._streams = {
            name: np.random.Generator(np.random.PCG64([seed, number]))
            for number, name in enumerate(_PROBABILITIES)
        }

    def strikes(self, name: str) -> bool:
        """Return True if the fault ``name`` occurs this time."""
        probability: float = getattr(self.faults, name)
        return probability > 0.0 and bool(self._streams[name].random() < probability)

    def lose(self, data: bytes) -> bytes:
        """Return the part of ``data``, sent by the host, that reaches the device."""
        if not data or not self.strikes("lose"):
            return data
        self.spoilt += 1
        place = int(self._streams["lose"].integers(len(data)))
        return data[:place] + data[place + 1 :]

    def spoil(self, line: bytes) -> bytes:
        """Return the part of ``line``, with its terminator, that reaches the host."""
        spoilt = line
        if self.strikes("terminator"):
            spoilt = spoilt.rstrip(b"\r\n") + b"\n"
        if self.strikes("garble"):
            place = int(self._streams["garble"].integers(len(spoilt)))
            other = bytes([(spoilt[place] + 1 + int(self._streams["garble"].integers(255))) & 0xFF])
            spoilt = spoilt[:place] + other + spoilt[place + 1 :]
        if self.strikes("truncate"):
            spoilt = spoilt[: int(self._streams["truncate"].integers(len(spoilt)))]
        if self.strikes("drop"):
            spoilt = b""
        if self.strikes("noise"):
            spoilt = self._streams["noise"].bytes(int(self._streams["noise"].integers(1, 9))) + spoilt
        self.spoilt += spoilt != line
        return spoilt


OUTPUT_BYTES_MAX = 1 << 16
"""Output waiting for a host that does not read; a line beyond it is lost."""
_PACED_BYTES = 16
"""Read at a time from a line that has a speed, as from the FIFO of a UART."""


class DeviceLine:
    """Bytes in and lines out, at the speed of the line; nothing here waits."""

    def __init__(self, terminal: PseudoTerminal, faults: LineFaults, seed: int) -> None:
        self.terminal = terminal
        self.spoiler = LineSpoiler(faults, seed)
        self.lines_lost = 0
        """Lines for which the host left no room."""
        self._faults = faults
        self._output: deque[tuple[Instant, bytes]] = deque()
        self._output_bytes = 0
        self._output_free_at = Instant(0)
        self._readable_at = Instant(0)
        self._unplug_at: Instant | None = None

    def start(self, now: Instant) -> None:
        """The device's start, from which an unplugging counts."""
        self._unplug_at = self._faults.goes_at(now)

    def read(self, now: Instant) -> bytes:
        """Return the host's data that the line has carried by ``now``."""
        if now < self._readable_at:
            return b""
        self._readable_at = Instant(0)
        paced = bool(self._faults.baud)
        data = self.terminal.read(_PACED_BYTES if paced else READ_BYTES)
        if paced and data:
            self._readable_at = Instant(now + self._faults.time_on_line(len(data)))
        return self.spoiler.lose(data)

    def send(self, line: bytes, now: Instant) -> bool:
        """Queue a line for the host, spoilt as the faults have it; False if there was no room."""
        data = self.spoiler.spoil(line)
        if self._output_bytes + len(data) > OUTPUT_BYTES_MAX:
            self.lines_lost += 1
            return False
        start = max(Instant(now + round(self._faults.late_ms * NS_PER_MS)), self._output_free_at)
        self._output_free_at = due = Instant(start + self._faults.time_on_line(len(data)))
        if data:
            self._output.append((due, data))
            self._output_bytes += len(data)
        self.flush(now)
        return True

    def flush(self, now: Instant) -> None:
        """Hand over what is due, as far as the pseudo-terminal has room; go away when that is due."""
        if self._unplug_at is not None and now >= self._unplug_at:
            self.terminal.unplug()
        while self._output and self._output[0][0] <= now:
            due, data = self._output[0]
            taken = self.terminal.write(data)
            self._output_bytes -= taken
            if taken < len(data):
                self._output[0] = (due, data[taken:])
                return
            self._output.popleft()

    def holds_back(self, now: Instant) -> bool:
        """The line is still busy with what the host sent before."""
        return now < self._readable_at

    @property
    def blocked(self) -> bool:
        """The pseudo-terminal has no room for what is due."""
        return bool(self._output)

    def due_at(self) -> Instant | None:
        """When something is to be done that no descriptor shows; None: nothing."""
        dues = [self._output[0][0]] if self._output else []
        if self._readable_at:
            dues.append(self._readable_at)
        if self._unplug_at is not None:
            dues.append(self._unplug_at)
        return min(dues, default=None)
