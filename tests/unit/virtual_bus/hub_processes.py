"""The hub of one test, and other processes on it. Every wait is bounded by a deadline."""

import subprocess
import sys
from pathlib import Path

from servobench.drivers.timebase import NS_PER_MS, Instant, MonotonicClock, instant_after
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.bus.hub_place import HubPlace

PATIENCE_S = 10.0
CLOCK = MonotonicClock()
REPOSITORY = Path(__file__).parents[3]


def join(buses: list[HubBus], **options: bool | int) -> HubBus:
    buses.append(HubBus("bench", **options))  # type: ignore[arg-type]
    return buses[-1]


def broker_process(place: HubPlace) -> int:
    return int(place.alive.read_text())


def wait_for_end(process: int) -> None:
    """Until the process is gone (it is nobody's child here)."""
    deadline = instant_after(CLOCK.now(), PATIENCE_S)
    while Path(f"/proc/{process}").exists():
        assert CLOCK.now() < deadline, f"process {process} still runs"
        CLOCK.sleep_until(Instant(CLOCK.now() + 10 * NS_PER_MS))


def participant(script: str) -> subprocess.Popen[str]:
    """Another process that joined the hub as ``bus``; it says so on its standard output."""
    source = (
        "import can, sys\n"
        "bus = can.Bus(interface='hub', channel='bench', ignore_config=True)\n"
        f"print('joined', flush=True)\n{script}\nbus.shutdown()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", source],
        cwd=REPOSITORY,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "joined\n"
    return process


def end(process: subprocess.Popen[str]) -> str:
    """Wait for a participant; what it said since."""
    output, _ = process.communicate(timeout=PATIENCE_S)
    return output
