"""``hil run`` that stands still at its beginning, and where it enters a phase, until it is told to go on.

``python -m tests.exits.held_host PHASE TOLD ANSWER WITNESS SLOW run ...``. TOLD and ANSWER are descriptors.
To the one a line is written, with the instant on the bench's clock; from the other a line is awaited, which
names a file that is to fill the disk, or none. WITNESS takes what the drives of a simulated bus do. While
the file SLOW is there, each write of the recorder takes long.
"""

import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import ClassVar, Final
from unittest.mock import patch

from servobench.drivers.timebase import MonotonicClock
from servobench.hil.cli import app
from servobench.hil.machine import progress
from servobench.hil.recording import logger_process
from servobench.virtual_bus.child_python import python_command
from tests.exits.cells import CONNECTING, RUNNING
from tests.exits.written_witness import WrittenWitness
from tests.swarm.witness import DriveWitness, witnessed

TURNING_S: Final = 0.3
"""From the first cycle until the shaft turns."""
_BLOCK: Final = bytes(4096)


class HeldProgress(progress.TerminalProgress):
    """Tells its phases, and stands still in some of them, once."""

    held: ClassVar[list[str]] = []
    told = answer = -1
    drives: ClassVar[list[DriveWitness]] = []

    def __call__(self, phase: str, elapsed_s: float) -> None:
        super().__call__(phase, elapsed_s)
        if phase == self.held[0] and (phase != RUNNING or elapsed_s >= TURNING_S):
            self.held.pop(0)
            now = max((drive.seen_at for drive in self.drives), default=MonotonicClock().now())
            os.write(self.told, f"{now}\n".encode())
            filler = _line(self.answer)
            if filler:
                fill(Path(filler))


def _line(descriptor: int) -> str:
    found = b""
    while not found.endswith(b"\n"):
        found += (read := os.read(descriptor, 256))
        if not read:
            break
    return found.decode().strip()


def fill(path: Path) -> None:
    """Until the disk is full."""
    with suppress(OSError), path.open("wb", buffering=0) as file:
        while file.write(_BLOCK):
            pass


def main() -> None:
    """Run the bench."""
    phase, told, answer, witness, slow = sys.argv[1:6]
    HeldProgress.held = [*dict.fromkeys((CONNECTING, phase)), ""]
    HeldProgress.told, HeldProgress.answer = int(told), int(answer)
    del sys.argv[1:6]

    def slow_disk(module: str, *arguments: str) -> list[str]:
        return python_command("tests.exits.slow_disk", module, slow, *arguments)

    with (
        witnessed(HeldProgress.drives, lambda drive: WrittenWitness(drive, Path(witness))),
        patch.object(logger_process, "python_command", slow_disk),
        patch.object(progress, "TerminalProgress", HeldProgress),
    ):
        app()


if __name__ == "__main__":
    main()
