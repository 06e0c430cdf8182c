"""A drive in a thread on a real-time bus, its client, and a monitor with a thread of its own."""

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import can

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.timebase import MonotonicClock
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.hosting.devices import serve
from tests.contract.modes_suite import NODE, WRITES, ModesRig
from tests.motors import LING

END_LIMIT_S = 20.0


@contextmanager
def live_modes(open_bus: Callable[[], can.BusABC], stamps: StampSource) -> Iterator[ModesRig]:
    """An enabled drive that is served while the block is entered."""
    clock, device = MonotonicClock(), SimulatedServo(NODE, LING)
    stop, asked = threading.Event(), queue.SimpleQueue[Callable[[SimulatedServo], None]]()

    def ended() -> bool:
        """Asked by whoever serves the device, between two frames: the place to do something to it."""
        while not asked.empty():
            device.wake(clock.now())
            asked.get()(device)
            device.wake(clock.now())
        return stop.is_set()

    served_bus, bus, listening = open_bus(), open_bus(), open_bus()
    served = threading.Thread(target=serve, args=([device], served_bus, clock, ended))
    network = CanopenNetwork(BusLink(bus, clock, stamps, "live"), clock, writes=WRITES)
    rig = ModesRig(network, device, ServoDrive(network, NODE, "axis1"), asked.put)

    def hear(message: can.Message) -> None:
        rig.heard.append((message.arbitration_id, bytes(message.data)))

    notifier = can.Notifier(listening, [hear], timeout=0.05)
    served.start()
    try:
        rig.start()
        yield rig
    finally:
        stop.set()
        served.join(END_LIMIT_S)
        notifier.stop()
        for opened in (served_bus, bus, listening):
            opened.shutdown()
    assert not served.is_alive()
