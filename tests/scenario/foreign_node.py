"""Nodes that a bench knows nothing of, on its simulated segment: what they send, and when."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

from servobench.drivers.timebase import Duration, Instant, duration_s
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution import bench, world
from servobench.hil.execution.simulated_drives import simulated_drives
from servobench.hil.execution.world import World, WorldPlan
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice


class ForeignNode:
    """A device that sends ``frame`` from ``at_s`` after its power-on, ``times`` times, and hears nothing."""

    def __init__(self, frame: Frame, at_s: float, times: int = 1, period_s: float = 0.001) -> None:
        self.wake_at: Instant | None = None
        self.sent_at: list[Instant] = []
        self._frame = frame
        self._after = duration_s(at_s)
        self._left = times
        self._period = duration_s(period_s)

    def start(self, now: Instant) -> Sequence[Frame]:
        self.wake_at = Instant(now + self._after)
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        del frame, now
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        self._left -= 1
        self.sent_at.append(now)
        self.wake_at = Instant(now + self._period) if self._left else None
        return (self._frame,)


class Act:
    """A device that hears and sends nothing, and does something once, ``at_s`` after its power-on."""

    def __init__(self, at_s: float, do: Callable[[Instant], None]) -> None:
        self.wake_at: Instant | None = None
        self._after = duration_s(at_s)
        self._do = do

    def start(self, now: Instant) -> Sequence[Frame]:
        self.wake_at = Instant(now + self._after)
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        del frame, now
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        self.wake_at = None
        self._do(now)
        return ()


def put_on_the_bus(world: World, *nodes: Any) -> None:
    """Have ``nodes`` on the first segment of a simulated world."""
    bus: Any = world.link.bus
    while not hasattr(bus, "segment"):
        bus = bus.inner
    for node in nodes:
        AttachedDevice(node, bus.segment, "foreign")


@contextmanager
def beside_the_bench(
    *nodes: Any, copies: bool = False, seen: Callable[[SimulatedServo], object] = bool
) -> Iterator[None]:
    """Runs of benches inside have ``nodes`` on their segment; ``copies``: and each drive twice; ``seen`` is
    given each drive."""

    def drives(config: BenchConfig) -> list[SimulatedServo]:
        made = [drive for _ in range(1 + copies) for drive in simulated_drives(config)]
        for drive in made:
            seen(drive)
        return made

    @contextmanager
    def open_world(plan: WorldPlan, devices: Sequence[Any]) -> Iterator[World]:
        with world.open_world(plan, devices) as made:
            put_on_the_bus(made, *nodes)
            yield made

    with (
        patch.object(bench, "open_world", open_world),
        patch("servobench.hil.execution.simulated_drives.simulated_drives", drives),
    ):
        yield


LATE = Duration(2_000_000)
"""A frame waits for the bus for less than this, ns, where a bench of one axis runs."""
