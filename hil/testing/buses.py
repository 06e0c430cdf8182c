"""Which bus a test is on."""

import itertools
import os

from drivers.errors import BusDown
from drivers.wire.adapters import SOCKETCAN, link_up_command, socketcan_links

SIMULATED, HUB, VCAN = "simulated", "hub", "vcan"
_numbers = itertools.count(1)


def bus_spec(name: str) -> str:
    """A bus SPEC; ``hub`` alone stands for a hub that no other test has, ``vcan`` for socketcan:vcan0."""
    if name == HUB:
        return f"{HUB}:test-{os.getpid()}-{next(_numbers)}"
    if name == VCAN:
        return f"{SOCKETCAN}:vcan0"
    return name


def require_up(spec: str) -> None:
    """Raises BusDown, with the command that mends it, for a SocketCAN interface that is not up."""
    interface, _, channel = spec.partition(":")
    if interface != SOCKETCAN:
        return
    if not any(adapter.spec == spec and adapter.usable for adapter in socketcan_links()):
        raise BusDown(f"{channel} is not up", remedy=link_up_command(channel))
