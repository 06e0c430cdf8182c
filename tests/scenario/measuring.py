"""A measurement on a simulated bus of the test's own, in simulated time."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.errors import TransferAborted
from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.configuration.bench_file import faults_from
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.machine.progress import Progress, no_progress
from servobench.hil.machine.stopping import StopRequest
from servobench.hil.measuring.figures import Measured
from servobench.hil.measuring.measure import Measurement
from servobench.hil.measuring.subject import MeasureRequest
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING

VOLATILE = frozenset({0x1003, 0x1013, 0x6040})
"""History, clock and command."""
REQUEST = MeasureRequest(
    bus="simulated",
    nodes=(1,),
    cycles=1000,
    period_us=1000,
    bitrate_bit_s=1_000_000,
    enable=False,
    speed_max_rad_s=10.0,
)

Faults = Mapping[str, Any]


class Rig:
    """Drives on a simulated bus, and measurements of them."""

    def __init__(self, world: World, servos: Sequence[SimulatedServo], folder: Path) -> None:
        self.world = world
        self.servos = servos
        self.folder = folder
        self.said: list[str] = []

    def measure(
        self,
        stop: StopRequest | None = None,
        progress: Progress = no_progress,
        **wish: Any,
    ) -> Measured:
        """``wish``: what differs from REQUEST."""
        request = replace(REQUEST, nodes=tuple(servo.node_id for servo in self.servos), **wish)
        measurement = Measurement(
            request, self.world, stop or StopRequest(), self.folder, self.said.append, progress
        )
        return measurement.to_the_end()

    def memory(self) -> dict[tuple[int, int, int], bytes]:
        """By node, index and sub-index: all that a master could have changed."""
        network = CanopenNetwork(self.world.link, self.world.clock, 126)
        held = {}
        for servo in self.servos:
            for entry in servo.dictionary:
                for sub, variable in entry.members.items():
                    if variable.writable and variable.readable and entry.index not in VOLATILE:
                        try:
                            value = network.upload(servo.node_id, entry.index, sub)
                        except TransferAborted:
                            continue
                        held[servo.node_id, entry.index, sub] = value
        return held


class StopAfter(StopRequest):
    """A Ctrl-C after so many seconds of simulated time."""

    def __init__(self, world: World, seconds: float) -> None:
        super().__init__()
        self._clock = world.clock
        self._at = world.clock.now() + round(seconds * NS_PER_S)

    def __call__(self) -> bool:
        if self._clock.now() >= self._at:
            self.ask("SIGINT")
        return super().__call__()

    def check(self) -> None:
        self()
        super().check()


@contextmanager
def measuring_rig(
    folder: Path,
    faults: Faults | None = None,
    *,
    nodes: Sequence[int] = (1,),
    lacks: tuple[str, ...] = (),
    seed: int = 1,
) -> Iterator[Rig]:
    """``faults``: the tables of a fault plan; ``lacks``: what the drives have not."""
    drive = DriveParameters(lacks=lacks)
    servos = [SimulatedServo(node, LING, drive, seed) for node in nodes]
    plan = faults_from(faults, "plan") if faults else None
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, plan, seed), servos) as world:
        yield Rig(world, servos, folder / "journals")
