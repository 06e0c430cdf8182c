"""Waiting for a drive's first answer, in which a user may lose patience."""

from drivers.cia402.drive_setup import Identity
from drivers.cia402.servo import ServoDrive
from drivers.errors import NoAnswer
from drivers.timebase import duration_s
from hil.machine.stopping import StopRequest

_SLICE_S = 0.3
"""How long a stop signal may wait to be heard."""


def connect(drive: ServoDrive, timeout_s: float, stop: StopRequest) -> Identity:
    """Who answers. Raises NoAnswer after ``timeout_s``, Interrupted once a stop signal has come."""
    network = drive.network
    deadline = network.deadline_after(duration_s(timeout_s))
    while True:
        stop.check()
        slice_end = min(deadline, network.deadline_after(duration_s(_SLICE_S)))
        try:
            return drive.connect(slice_end)
        except NoAnswer:
            if network.clock.now() >= deadline:
                raise
            network.pump(slice_end)  # a transfer that fails at once is not to flood the bus with the next
