"""Who makes the SYNC, and whether they can on a bus."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress

import can

from drivers.canopen.cob_ids import SYNC
from drivers.errors import BadInput, BusDown
from drivers.timebase import NS_PER_S, Duration
from drivers.wire.adapters import HUB, SOCKETCAN, BusSpec
from hil.configuration.config import BenchConfig


@contextmanager
def kernel_sync(bus: can.BusABC, period: Duration) -> Iterator[None]:
    """The bus's own cyclic sender makes SYNCs. Raises BusDown if it cannot."""
    message = can.Message(arbitration_id=SYNC, is_extended_id=False)
    try:
        task = bus.send_periodic(message, period / NS_PER_S)
    except (can.CanError, OSError, NotImplementedError) as error:
        raise BusDown("the bus's cyclic sender cannot make SYNCs", str(error)) from error
    try:
        yield
    finally:
        # If the interface is down, it sends none; the kernel forgets them when the bus is closed.
        with suppress(can.CanError, OSError):
            task.stop()


def sync_producer(source: str, bus: can.BusABC, period: Duration) -> AbstractContextManager[None]:
    """Who makes SYNCs on behalf of this process, as long as it is entered; ``source``: ``loop.sync``."""
    return kernel_sync(bus, period) if source == "kernel" else nullcontext()


def check_sync_source(config: BenchConfig, spec: BusSpec) -> None:
    """Raises BadInput if nobody can make the SYNCs of ``config`` as it wants on the bus ``spec``."""
    source = config.loop.sync
    if source == "kernel" and not spec.simulated and spec.interface != SOCKETCAN:
        expected = f"'own' or 'foreign' on the bus {spec}"
        why = "only SocketCAN and the bus 'simulated' send cyclic frames by themselves"
        if spec.interface == HUB:
            why += "; on a hub it would be a thread of this process"
        raise BadInput(config.source, "loop.sync", source, expected, why)
    if source == "foreign" and spec.simulated and not _produces_sync(config):
        raise BadInput(
            config.source,
            "loop.sync",
            source,
            "'own' or 'kernel' on the bus 'simulated', where nobody else makes SYNCs",
            "or let a [[bus.background]] with can_id = 0x080 and bytes_max = 0 make them",
        )


def _produces_sync(config: BenchConfig) -> bool:
    return any(entry.can_id == SYNC and not entry.extended for entry in config.bus.background)
