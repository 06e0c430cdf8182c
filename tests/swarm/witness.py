"""What the drives of a run did, seen from inside the drives: their states, their EMCYs, their shafts.

A witness stands innermost, behind every fault, so no fault hides anything from it. The bench knows nothing
of it.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final
from unittest.mock import patch

from drivers.profile402 import State
from drivers.timebase import Instant
from hil import bench, world
from hil.world import World, WorldPlan
from virtual_bus.frame import Frame
from virtual_bus.servo import SimulatedServo

EMCY_ID: Final = 0x080
VELOCITY: Final = 0x606C
VELOCITY_UNIT_RAD_S: Final = 2.0 * 3.141592653589793 / 60.0 * 1e-3
"""606Ch of the simulated drive counts 0.001 r/min."""


class DriveHistory:
    """What one drive did."""

    def __init__(self, node_id: int) -> None:
        self.node_id = node_id
        self.states: list[tuple[Instant, State]] = []
        """Each with the first instant at which it was seen."""
        self.emergencies: list[tuple[Instant, int]] = []
        """Error codes other than 0000h, each with when the drive sent it."""

    @property
    def speed_rad_s(self) -> float:
        """Of the shaft, when last seen."""
        raise NotImplementedError

    def enabled_throughout(self, first: Instant, last: Instant) -> bool:
        """Whether it was in OPERATION ENABLED from one instant to another."""
        before = [state for at, state in self.states if at <= first][-1:]
        inside = [state for at, state in self.states if first < at <= last]
        return bool(before) and all(state is State.OPERATION_ENABLED for state in (*before, *inside))


class DriveWitness(DriveHistory):
    """Stands in front of one simulated drive."""

    def __init__(self, drive: SimulatedServo) -> None:
        super().__init__(drive.node_id)
        self.seen_at = Instant(0)
        """When it last heard or did something."""
        self._drive = drive

    def __getattr__(self, name: str) -> Any:
        """What faults ask of the drive itself."""
        return getattr(self._drive, name)

    @property
    def speed_rad_s(self) -> float:
        """As the drive has it."""
        return int(self._drive.dictionary.variable(VELOCITY, 0).read()) * VELOCITY_UNIT_RAD_S

    def start(self, now: Instant) -> Sequence[Frame]:
        """See :class:`virtual_bus.frame.Device`."""
        return self._seen(self._drive.start(now), now)

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """See :class:`virtual_bus.frame.Device`."""
        return self._seen(self._drive.receive(frame, now), now)

    def wake(self, now: Instant) -> Sequence[Frame]:
        """See :class:`virtual_bus.frame.Device`."""
        return self._seen(self._drive.wake(now), now)

    def _seen(self, frames: Sequence[Frame], now: Instant) -> Sequence[Frame]:
        self.seen_at = now
        state = self._drive.drive_state
        if not self.states or self.states[-1][1] is not state:
            self.states.append((now, state))
        for frame in frames:
            if frame.can_id == EMCY_ID + self.node_id:
                code = int.from_bytes(frame.data[:2], "little")
                if code:
                    self.emergencies.append((now, code))
        return frames


@contextmanager
def witnessed(
    witness: Callable[[SimulatedServo], DriveWitness] = DriveWitness,
) -> Iterator[list[DriveWitness]]:
    """Every drive that a bench simulates in this process has a witness as long as the context lasts."""
    witnesses: list[DriveWitness] = []

    @contextmanager
    def open_world(plan: WorldPlan, devices: Sequence[Any]) -> Iterator[World]:
        watched: list[Any] = []
        for device in devices:
            if isinstance(device, SimulatedServo):
                witnesses.append(witness(device))
                watched.append(witnesses[-1])
            else:
                watched.append(device)
        with world.open_world(plan, watched) as made:
            yield made

    with patch.object(bench, "open_world", open_world):
        yield witnesses
