"""``hil simulate`` with a witness: ``python -m tests.exits.watched_drive FILE simulate ...``."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from unittest.mock import patch

import can

from drivers.timebase import Clock
from hil.cli import app
from hil.execution import simulated_drives
from tests.exits.written_witness import WrittenWitness
from virtual_bus.drive.servo import SimulatedServo
from virtual_bus.hosting.devices import serve


def main() -> None:
    """Serve the drives until Ctrl-C."""
    path = Path(sys.argv.pop(1))

    def watched(
        devices: Sequence[SimulatedServo], bus: can.BusABC, clock: Clock, stop: Callable[[], bool]
    ) -> None:
        serve([WrittenWitness(device, path) for device in devices], bus, clock, stop)

    with patch.object(simulated_drives, "serve", watched):
        app()


if __name__ == "__main__":
    main()
