"""SYNCs of a bench on the hub while a crowd is at its door: 5000 sockets that say nothing, ten that join.

Quiet and crowded phases in turns within one run, as a third client of the hub sees them. What is compared is
by how much the distance of two SYNCs differs from the period.
"""

import resource
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from drivers.canopen.cob_ids import SYNC
from drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Instant, MonotonicClock
from tests.scenario.processes import hub_name, long_bench, simulated_drive, start_run
from virtual_bus.bus.hub import HubBus
from virtual_bus.bus.hub_place import HubPlace

PERIOD_NS: Final = 10 * NS_PER_MS
"""Of examples/any_bus.toml."""
PHASES: Final = 8
PHASE_NS: Final = 2 * NS_PER_S
SOCKETS, JOINING = 5_000, 10
CLOCK: Final = MonotonicClock()


def main() -> None:
    """Print a table."""
    bus = hub_name("crowd")
    name = bus.removeprefix("hub:")
    quiet, crowded = list[int](), list[int]()
    with tempfile.TemporaryDirectory() as folder, simulated_drive(bus):
        bench = long_bench(Path(folder), 120.0)
        run = start_run(bench, bus, Path(folder) / "run")
        with HubBus(name, batches=True) as listener:
            while (frame := listener.recv(10.0)) is None or frame.arbitration_id != SYNC:
                pass
            for _ in range(PHASES):
                quiet += differences_ns(listener)
                crowd = subprocess.Popen([sys.executable, "-m", __spec__.name, name], stdout=subprocess.PIPE)
                assert crowd.stdout is not None
                crowd.stdout.readline()
                crowded += differences_ns(listener)
                crowd.kill()
                crowd.communicate()
        run.terminate()
        run.communicate()
    print(f"{'us':10} {'SYNCs':>7} {'p50':>7} {'p99':>7} {'p99.9':>7} {'max':>8}")
    for title, found in (("quiet", quiet), ("crowded", crowded)):
        quantiles = np.percentile(np.array(found) / NS_PER_US, [50, 99, 99.9, 100])
        print(f"{title:10} {len(found):7}", *(f"{each:7.1f}" for each in quantiles))
    ratio = np.percentile(crowded, 99.9) / np.percentile(quiet, 99.9)
    print(f"p99.9, crowded over quiet: {ratio:.2f}")


def differences_ns(listener: HubBus) -> list[int]:
    """Of one phase; what came before it is left out."""
    port = listener.frame_port
    begins = CLOCK.now()
    ends, last, found = begins + PHASE_NS, None, list[int]()
    while CLOCK.now() < ends:
        frame = port.receive(Instant(CLOCK.now() + 100 * NS_PER_MS))
        if frame is None or frame.can_id != SYNC or port.came_at < begins:
            continue
        if last is not None:
            found.append(abs(port.came_at - last - PERIOD_NS))
        last = port.came_at
    return found


def crowd(name: str) -> None:
    """Knock and join until it is killed; a line says that it has begun."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    place = HubPlace(name)
    print("here", flush=True)
    while True:
        knocking = list[socket.socket]()
        for number in range(min(SOCKETS, most - 100)):
            knocking.append(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
            knocking[-1].connect(str(place.socket))
            if number % (SOCKETS // JOINING) == 0:
                HubBus(name).shutdown()
        for each in knocking:
            each.close()


if __name__ == "__main__":
    if sys.argv[1:]:
        crowd(sys.argv[1])
    else:
        main()
