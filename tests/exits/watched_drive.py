"""``hil simulate`` with a witness: ``python -m tests.exits.watched_drive FILE simulate ...``."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from unittest.mock import patch

import can

from servobench.drivers.timebase import Clock
from servobench.hil.cli import app
from servobench.hil.execution import simulated_drives
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.hosting.devices import serve
from tests.exits.written_witness import WrittenWitness


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
