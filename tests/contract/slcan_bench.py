"""Emulated SLCAN adapters on pseudo-terminals, each in a thread, for the tests of the serial path."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from servobench.drivers.timebase import MonotonicClock
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.virtual_bus.instruments.serial_line import LineFaults, PseudoTerminal
from servobench.virtual_bus.instruments.slcan_server import AdapterServer, open_far_side
from tests.contract.bus_suite import PATIENCE_S, SILENCE_S, BusSuite, OpenBus, data_message, fetch


class SlcanSuite(BusSuite):
    """The contract for a bus whose stamps tell when the host read a frame, and not when it was sent."""

    def test_periodic_message_goes_out_again_and_again_until_stopped(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        task = sender.send_periodic(data_message(0x080), 0.002)
        fetch(receiver, 10)
        task.stop()
        while receiver.recv(SILENCE_S) is not None:
            pass
        assert receiver.recv(2 * SILENCE_S) is None
        sender.send(data_message(0x081))
        last = receiver.recv(PATIENCE_S)
        assert last is not None
        assert last.arbitration_id == 0x081


class RunningAdapter:
    """An adapter at work; ``port`` is what a user would open."""

    def __init__(
        self, bus: str, bitrate_bit_s: int | None = None, faults: LineFaults | None = None, seed: int = 0
    ) -> None:
        self._bus, rate = open_far_side(parse_bus_spec(bus), bitrate_bit_s)
        self.terminal = PseudoTerminal()
        self.port = self.terminal.path
        self.server = AdapterServer(self._bus, rate, self.terminal, MonotonicClock(), faults, seed)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.server.serve, args=(self._stop.is_set,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Unplug it."""
        self._stop.set()
        self._thread.join(5.0)
        self.terminal.unplug()
        self._bus.shutdown()


@contextmanager
def running_adapter(
    bus: str, bitrate_bit_s: int | None = None, faults: LineFaults | None = None, seed: int = 0
) -> Iterator[RunningAdapter]:
    """An adapter on ``bus`` for as long as the block lasts."""
    adapter = RunningAdapter(bus, bitrate_bit_s, faults, seed)
    try:
        yield adapter
    finally:
        adapter.close()


def own_runtime(folder: Path) -> str:
    """A directory for hubs that belongs to one test module."""
    folder.mkdir(mode=0o700, exist_ok=True)
    return str(folder)
