"""A node of a hub that makes SYNCs, in a process of its own.

``python -m tests.truth.sync_process NAME PERIOD_US JITTER_US SEED`` sends them until its standard input ends.
Each is due on a grid, up to JITTER_US later, drawn from SEED, and comes later still by as much as the machine
keeps a process waiting.
"""

import os
import random
import select
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

import can

from servobench.drivers.canopen.cob_ids import SYNC
from servobench.drivers.timebase import NS_PER_US, Instant, MonotonicClock
from servobench.hil.machine.realtime import timing_conditions
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.frame import Frame

_PATIENCE_S: Final = 30.0
_READY: Final = "sending"


@contextmanager
def making_syncs(hub: str, period_us: int, jitter_us: int, seed: int) -> Iterator[None]:
    """SYNCs on ``hub`` until the context ends."""
    command = [sys.executable, "-m", __name__, hub, str(period_us), str(jitter_us), str(seed)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ
    )
    try:
        assert process.stdout is not None
        if process.stdout.readline().strip() != _READY:
            raise AssertionError(f"the producer of SYNC ended with {process.wait()}")
        yield
    finally:
        process.communicate(timeout=_PATIENCE_S)
    if process.returncode:
        raise AssertionError(f"the producer of SYNC ended with {process.returncode}")


def main() -> None:
    """The producer's process."""
    hub, (period_us, jitter_us, seed) = sys.argv[1], map(int, sys.argv[2:])
    bus, clock, draw = HubBus(hub, batches=True), MonotonicClock(), random.Random(seed)
    print(_READY, flush=True)
    with timing_conditions(True, True):  # as a kernel's timer is on time
        _send(bus, clock, period_us, jitter_us, draw)
    bus.shutdown()


def _send(bus: HubBus, clock: MonotonicClock, period_us: int, jitter_us: int, draw: random.Random) -> None:
    due = clock.now()
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        due = Instant(max(due, clock.now() - period_us * NS_PER_US) + period_us * NS_PER_US)
        clock.sleep_until(Instant(due + draw.randint(0, jitter_us) * NS_PER_US))
        with suppress(can.CanOperationError):  # the hub's process stood still for longer than its queue
            bus.frame_port.transmit(Frame(SYNC))
        while bus.frame_port.receive(Instant(0)) is not None:
            pass


if __name__ == "__main__":
    main()
