"""What befalls a run from outside of its own plan: killed processes, disks, frames of strangers.

As with the bench, the draw depends on the number of the case alone. When the host is killed is an instant of
simulated time, and so the same in every repetition; how far a logger has come by then is not.
"""

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from random import Random
from typing import Final
from unittest.mock import patch

from servobench.drivers.timebase import NS_PER_MS, Duration, Instant, MonotonicClock
from servobench.hil.recording.append_file import AppendFile
from servobench.virtual_bus.frame import Frame
from tests.scenario.foreign_node import ForeignNode


class Mishap(StrEnum):
    """Of the processes of a run, or of its disk."""

    NONE = "none"
    LOGGER_KILLED = "the logger is killed at an instant of the run"
    LOGGER_DIES = "the logger is killed in the middle of writing"
    HOST_KILLED = "the host is killed at an instant of the run"
    BOTH_KILLED = "host and logger are killed at an instant of the run"
    DISK_FULL = "the disk fills up"
    DISK_SLOW = "the disk is slow"


BEFORE_S: Final = 0.3
"""Connecting and enabling the drives take about so long; the last of what happens comes while they stop."""
DISK_BYTES: Final = (16 * 1024, 700 * 1024)
"""From one that has no room for the start, to one that has for most runs."""
SLOW_WRITES: Final = 40
SLOW_MS: Final = (1, 3)
STRIKE: Final = signal.SIGUSR1
"""Kills, and nobody else sends it: a logger that has given its summary may be ended by SIGKILL."""
SEND_S: Final = (0.0005, 0.001, 0.02)


@dataclass(frozen=True)
class Circumstances:
    """Of one case."""

    mishap: Mishap
    at_s: float
    """After power-on, of what has an instant."""
    count: int
    """Of writes until the logger dies, of bytes of the disk, of ms that a write takes."""
    strangers: tuple[ForeignNode, ...]


def circumstances(number: int, duration_s: float, nodes: int) -> Circumstances:
    """Of case ``number``, whose run lasts ``duration_s`` and has drives of the node-IDs 1 to ``nodes``."""
    draw = Random(f"mishap {number}")
    mishap = draw.choice((*[Mishap.NONE] * 6, *list(Mishap)[1:]))
    last_s = BEFORE_S + 1.1 * duration_s
    count = {
        Mishap.LOGGER_DIES: draw.randrange(60),
        Mishap.DISK_FULL: draw.randrange(*DISK_BYTES),
        Mishap.DISK_SLOW: draw.randint(*SLOW_MS),
    }
    strangers = [_stranger(draw, last_s, nodes) for _ in range(draw.choice((0, 0, 0, 1, 2, 3)))]
    at_s = round(draw.uniform(0.0, last_s), 4)
    return Circumstances(mishap, at_s, count.get(mishap, 0), tuple(strangers))


def _stranger(draw: Random, last_s: float, nodes: int) -> ForeignNode:
    times = draw.choice((1, 1, 3, 100))
    at_s = round(draw.uniform(0.0, last_s), 4)
    return ForeignNode(_hostile(draw, draw.randint(1, nodes)), at_s, times, draw.choice(SEND_S))


def _hostile(draw: Random, node: int) -> Frame:
    """What nobody but the bench or its drives should send."""
    state = bytes([draw.choice((0, 4, 5, 127, 255))])
    word = draw.choice((0x00, 0x02, 0x06, 0x07, 0x0F, 0x80, draw.randrange(1 << 16))).to_bytes(2, "little")
    length = draw.randint(0, 8)
    request = draw.choice(("4000100000000000", "2316100100000000", "2B40600006000000", "2B4060000F000000"))
    return draw.choice(
        (
            Frame(0x000, bytes((draw.choice((0x01, 0x02, 0x80, 0x81, 0x82, 0x55)), draw.choice((0, node))))),
            Frame(0x000, draw.randbytes(length)),
            Frame(0x080, draw.choice((b"", b"\x01"))),
            Frame(0x77F, state),
            Frame(0x700 + node, state),
            Frame(0x080 + node, draw.randbytes(8)),
            Frame(0x100, draw.randbytes(6)),
            Frame(0x200 + node, word + draw.randbytes(2)),
            Frame(0x200 + node, draw.randbytes(length)),
            Frame(0x180 + 0x100 * draw.randrange(4) + node, draw.randbytes(length)),
            Frame(0x600 + node, bytes.fromhex(request)),
            Frame(0x600 + node, draw.randbytes(length)),
            Frame(0x580 + node, draw.randbytes(length)),
            Frame(0x7E5, draw.randbytes(8)),
            Frame(draw.randrange(1 << 29), draw.randbytes(length), extended=True),
            Frame(draw.randrange(1 << 11), b"", remote=True),
        )
    )


def disturbed(found: Circumstances, program: Callable[[], int]) -> Callable[[], int]:
    """A logger's program with what befalls its writing."""
    if found.mishap is Mishap.LOGGER_DIES:
        return lambda: _with_write(_Dying(found.count).write, program)
    if found.mishap is Mishap.DISK_SLOW:
        return lambda: _with_write(_Slow(Duration(found.count * NS_PER_MS)).write, program)
    return program


_WRITE: Final = AppendFile.write


def _with_write(write: Callable[[AppendFile, bytes, int], None], program: Callable[[], int]) -> int:
    with patch.object(AppendFile, "write", lambda file, data, *, unit=0: write(file, data, unit)):
        return program()


class _Dying:
    def __init__(self, writes: int) -> None:
        self._left = writes

    def write(self, file: AppendFile, data: bytes, unit: int) -> None:
        """Half of it, and no more, once there were enough."""
        if self._left:
            self._left -= 1
            _WRITE(file, data, unit=unit)
            return
        _WRITE(file, data[: len(data) // 2], unit=unit)
        os.kill(os.getpid(), STRIKE)


class _Slow:
    def __init__(self, takes: Duration) -> None:
        self._left = SLOW_WRITES
        self._takes = takes
        self._clock = MonotonicClock()

    def write(self, file: AppendFile, data: bytes, unit: int) -> None:
        """Later, the first times."""
        if self._left:
            self._left -= 1
            self._clock.sleep_until(Instant(self._clock.now() + self._takes))
        _WRITE(file, data, unit=unit)
