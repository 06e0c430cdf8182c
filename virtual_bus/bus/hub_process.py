"""The process behind ``hub:NAME``, and what it asks of the kernel and of Python to be on time."""

import ctypes
import gc
import os
import resource
import signal
import sys

from servobench.drivers.timebase import MonotonicClock
from servobench.virtual_bus.bus.hub_broker import Broker, listen
from servobench.virtual_bus.bus.hub_place import HubPlace, try_lock

_PR_SET_TIMERSLACK = 29
_FIFO_PRIORITY = 60
"""Above a control loop (servobench.hil.machine.realtime): the bus has to be on time before anybody on it can
be."""
_BUSY_US_MAX = 100_000
"""CPU time without once sleeping, after which the process is put back among the ordinary ones."""


def ask_for_punctuality() -> None:
    """Timers without slack, no garbage collector, SCHED_FIFO; what is refused is done without."""
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    gc.collect()
    gc.freeze()
    gc.disable()
    _run_first()


def _run_first() -> None:
    """SCHED_FIFO for as long as the process sleeps in between: it must never keep a core from the others."""
    signal.signal(signal.SIGXCPU, lambda _signal, _frame: _run_as_others())
    try:
        resource.setrlimit(
            resource.RLIMIT_RTTIME, (_BUSY_US_MAX, resource.getrlimit(resource.RLIMIT_RTTIME)[1])
        )
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
    except (PermissionError, ValueError):
        _run_as_others()


def _run_as_others() -> None:
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def main() -> None:
    """``python -m servobench.virtual_bus.bus.hub_process NAME BITRATE``: returns once the hub can be
    joined."""
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
