"""The process behind ``hub:NAME``."""

import os
import sys

from drivers.timebase import MonotonicClock
from virtual_bus.bus.hub_broker import Broker, listen
from virtual_bus.bus.hub_place import HubPlace, try_lock
from virtual_bus.bus.punctuality import ask_for_punctuality


def main() -> None:
    """``python -m virtual_bus.bus.hub_process NAME BITRATE``: returns once the hub can be joined."""
    name, bitrate = sys.argv[1:]
    place = HubPlace(name)
    alive = try_lock(place.alive)
    if alive is None:
        return  # there is one already: its caller was only too slow to be welcomed
    listener = listen(place)
    if os.fork():
        os._exit(0)  # the caller waits for this process: the hub is up, and is nobody's child
    os.setsid()
    os.chdir("/")
    os.ftruncate(alive, 0)
    os.write(alive, f"{os.getpid()}\n".encode())
    ask_for_punctuality()
    Broker(place, listener, alive, MonotonicClock(), int(bitrate)).run()


if __name__ == "__main__":
    main()
