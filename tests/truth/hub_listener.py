"""A third, passive client of a hub: every frame with the broker's end of frame, in a process of its own.

``python -m tests.truth.hub_listener NAME FILE`` listens until its standard input ends, then writes FILE.
"""

import gc
import os
import select
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_S
from servobench.virtual_bus.bus.hub import HubBus

FRAME_DTYPE: Final = np.dtype([("at", "<i8"), ("can_id", "<u4"), ("length", "u1"), ("data", "S8")])
FrameTable = NDArray[np.void]
"""(n,) of FRAME_DTYPE: end of frame on CLOCK_MONOTONIC, ns; identifier; data, filled up with zeros."""
_ROW: Final = struct.Struct("<qIB8s")
_PATIENCE_S: Final = 30.0
_POLL_S: Final = 0.2
_FRAMES_A_TURN: Final = 100
"""Between two looks at whether to end."""
_READY: Final = "listening"


@contextmanager
def listening(hub: str, file: Path) -> Iterator[None]:
    """Listen from now until the context ends; ``file`` then holds what :func:`heard` reads."""
    command = [sys.executable, "-m", __name__, hub, str(file)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ
    )
    try:
        assert process.stdout is not None
        if process.stdout.readline().strip() != _READY:
            raise AssertionError(f"the listener ended with {process.wait()}")
        yield
    finally:
        process.communicate(timeout=_PATIENCE_S)
    if process.returncode:
        raise AssertionError(f"the listener ended with {process.returncode}: what it heard is not known")


def heard(file: Path) -> FrameTable:
    """What a listener has written."""
    return np.fromfile(file, FRAME_DTYPE)


def main() -> None:
    """The listener's process."""
    hub, file = sys.argv[1], Path(sys.argv[2])
    bus = HubBus(hub)
    gc.disable()  # a pause of the collector is as long as a hub waits for a client that takes no frames
    table = bytearray()
    print(_READY, flush=True)
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        for _ in range(_FRAMES_A_TURN):
            message = bus.recv(_POLL_S)
            if message is None:
                break
            at = round(message.timestamp * NS_PER_S)
            table += _ROW.pack(at, message.arbitration_id, message.dlc, bytes(message.data))
    bus.shutdown()
    file.write_bytes(table)


if __name__ == "__main__":
    main()
