"""Whether the machine stood still while a test in real time ran, and what no standing still excuses.

Run as a program it is the witness: a process of its own that wants to wake every :data:`EVERY_S`, and prints
by how many it came late. It ends with its standard input.
"""

import os
import select
import subprocess
import sys
from typing import Final

from servobench.drivers.timebase import NS_PER_MS, MonotonicClock

EMULATED: Final = "SERVOBENCH_EMULATED" in os.environ
"""This is User Mode Linux or QEMU, whose time means nothing."""
EVERY_S: Final = 0.01 if EMULATED else 0.002
"""A wake-up costs an emulated machine 200 us of its only processor."""
EXCUSED_MS: Final = 10
"""A process that waited so long for its turn has lost ten cycles of a loop at 1 kHz. A test in real time
needs a machine that does better; where this one did not, the test may be tried again."""
STOOD_STILL_MS: Final = 40
"""Two periods of the slowest bench whose frames have to come in time: here benches end by their own guards,
as they should, and no test of what a bench does otherwise can pass."""


class Untrue(AssertionError):
    """What was told is not what happened: whatever the machine did, that must not be."""


class Witness:
    """Watches the machine from now on."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self._process.stdout is not None
        self._told = self._process.stdout.fileno()
        self._late_ms = max(map(int, os.read(self._told, 16).split()))  # it may come late at once

    @property
    def process_id(self) -> int:
        """Of the witness."""
        return self._process.pid

    def begin(self) -> None:
        """From now on."""
        self.late_ms()
        self._late_ms = 0

    def late_ms(self) -> int:
        """By how many milliseconds a wake-up came late, at most, since ``begin``; 0 if by less than
        :data:`EXCUSED_MS`."""
        told = b""
        while select.select([self._told], [], [], 0.0)[0]:
            part = os.read(self._told, 1 << 16)
            if not part:
                raise AssertionError("nobody watches the machine any more")
            told += part
        self._late_ms = max(self._late_ms, *map(int, told.split()), 0)
        return self._late_ms

    def stop(self) -> None:
        """Watch no more; the process is ended, as a child that was forked may hold its input open."""
        self._process.kill()
        self._process.communicate()


def main() -> None:
    """The witness's process."""
    clock = MonotonicClock()
    before = clock.now()
    os.write(1, b"0\n")
    while not select.select([0], [], [], EVERY_S)[0]:
        now = clock.now()
        late_ms = (now - before) // NS_PER_MS - round(EVERY_S * 1e3)
        if late_ms >= EXCUSED_MS:
            os.write(1, b"%d\n" % late_ms)
        before = now


if __name__ == "__main__":
    main()
