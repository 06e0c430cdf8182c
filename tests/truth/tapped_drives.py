"""``hil simulate`` with a tap before each drive, behind the faults of the drive's side.

``python -m tests.truth.tapped_drives FILE simulate ...`` writes the RPDOs that the drives heard into FILE,
as a listener writes what it heard on the bus, when it is told to end. The drives are the nodes 1, 2, ...
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import can
import numpy as np

from servobench.drivers.timebase import Clock, Instant
from servobench.hil.cli import main as hil
from servobench.hil.execution import simulated_drives
from servobench.virtual_bus.frame import Device, Frame
from servobench.virtual_bus.hosting.devices import serve
from tests.truth.hub_listener import FRAME_DTYPE

HeardFrames = list[tuple[int, int, int, bytes]]


class CommandTap:
    """Stands in front of a drive and notes each of its RPDOs that it hears; the rest is the drive's own."""

    def __init__(self, device: Device, heard: HeardFrames, node_id: int) -> None:
        self._device = device
        self._heard = heard
        self._command_id = 0x200 + node_id

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    @property
    def wake_at(self) -> Instant | None:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        return self._device.wake_at

    def start(self, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        return self._device.start(now)

    def wake(self, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        return self._device.wake(now)

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        if frame.can_id == self._command_id:
            self._heard.append((now, frame.can_id, len(frame.data), frame.data))
        return self._device.receive(frame, now)


def main() -> None:
    """The process."""
    file = Path(sys.argv[1])
    heard: HeardFrames = []

    def tapped(devices: Sequence[Device], bus: can.BusABC, clock: Clock, stop: Callable[[], bool]) -> None:
        serve([CommandTap(device, heard, node) for node, device in enumerate(devices, 1)], bus, clock, stop)

    sys.argv = ["hil", *sys.argv[2:]]
    with patch.object(simulated_drives, "serve", tapped):
        try:
            hil()
        finally:
            np.array(heard, FRAME_DTYPE).tofile(file)


if __name__ == "__main__":
    main()
