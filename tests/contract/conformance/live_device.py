"""The device under test on a real-time bus: a whole simulated servo in a thread."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import can

from servobench.drivers.timebase import MonotonicClock
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.hosting.devices import serve
from tests.contract.conformance.rig import NODE
from tests.motors import LING

END_LIMIT_S = 20.0


@contextmanager
def live_servo(open_bus: Callable[[], can.BusABC], node_id: int = NODE) -> Iterator[SimulatedServo]:
    """A servo that is served while the block is entered."""
    device, stop, bus = SimulatedServo(node_id, LING), threading.Event(), open_bus()
    served = threading.Thread(target=serve, args=([device], bus, MonotonicClock(), stop.is_set))
    served.start()
    try:
        yield device
    finally:
        stop.set()
        served.join(END_LIMIT_S)
        bus.shutdown()
    assert not served.is_alive()
