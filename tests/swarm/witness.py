"""What the drives of a run did, seen from inside the drives: their states, their EMCYs, their shafts.

A witness stands innermost, behind every fault, so no fault hides anything from it. The bench knows nothing
of it.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final
from unittest.mock import patch

from servobench.drivers.cia402.profile import Mode, State, Status
from servobench.drivers.timebase import Instant
from servobench.hil.execution import bench
from servobench.hil.execution.world import World, WorldPlan
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame

EMCY_ID: Final = 0x080
VELOCITY: Final = 0x606C
VELOCITY_UNIT_RAD_S: Final = 2.0 * 3.141592653589793 / 60.0 * 1e-3
"""606Ch of the simulated drive counts 0.001 r/min."""
FOLLOWS, OTHER_MODE, TARGET_IGNORED = "", "another mode", "target ignored"
OTHER_TORQUE, FAR_TORQUE = "another torque", "quite another torque"
TORQUE_UNITS: Final = 2
"""Thousandths of the rated torque: as much as rounding can make of a set-point."""
FAR_UNITS, FAR_SHARE = 110, 0.25
"""By so much, and so much of the set-point, a measured torque must be off to prove anything: docs/timing.md
says 100, the rest is the lag of the current."""


@dataclass
class Testimony:
    """Of one drive."""

    node_id: int
    states: list[tuple[Instant, State]]
    """Each with the first instant at which it was seen."""
    emergencies: list[tuple[Instant, int]]
    """Error codes other than 0000h, each with when the drive sent it."""
    otherwise: list[tuple[Instant, str]] = field(default_factory=list)
    """Each change of what an enabled drive does instead of following; ``FOLLOWS``: nothing."""
    speed_rad_s: float = 0.0
    """Of the shaft when all is over, as the drive has it."""

    def astray(self, first: Instant, last: Instant, *whys: str) -> list[tuple[Instant, Instant]]:
        """When it did one of ``whys`` between two instants."""
        ends = [at for at, _ in self.otherwise[1:]] + [last]
        spans = [
            (max(begin, first), min(end, last))
            for (begin, why), end in zip(self.otherwise, ends, strict=False)
            if why in whys
        ]
        joined: list[tuple[Instant, Instant]] = []
        for begin, end in spans:
            if joined and joined[-1][1] == begin:
                joined[-1] = joined[-1][0], end
            elif begin < end:
                joined.append((begin, end))
        return joined

    def enabled_throughout(self, first: Instant, last: Instant) -> bool:
        """Whether it was in OPERATION ENABLED from one instant to another."""
        before = [state for at, state in self.states if at <= first][-1:]
        inside = [state for at, state in self.states if first < at <= last]
        return bool(before) and all(state is State.OPERATION_ENABLED for state in (*before, *inside))


class DriveWitness:
    """Stands in front of one simulated drive."""

    def __init__(self, drive: SimulatedServo) -> None:
        self.seen_at = Instant(0)
        """When it last heard or did something."""
        self._drive = drive
        self._seen_so_far = Testimony(drive.node_id, [], [])

    def __getattr__(self, name: str) -> Any:
        """What faults ask of the drive itself."""
        return getattr(self._drive, name)

    def testimony(self) -> Testimony:
        """All until now."""
        raw = int(self._drive.dictionary.variable(VELOCITY, 0).read())
        self._seen_so_far.speed_rad_s = raw * VELOCITY_UNIT_RAD_S
        return self._seen_so_far

    def start(self, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        return self._seen(self._drive.start(now), now)

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        return self._seen(self._drive.receive(frame, now), now)

    def wake(self, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        return self._seen(self._drive.wake(now), now)

    def _seen(self, frames: Sequence[Frame], now: Instant) -> Sequence[Frame]:
        self.seen_at = now
        state, seen = self._drive.drive.power.state, self._seen_so_far
        if not seen.states or seen.states[-1][1] is not state:
            seen.states.append((now, state))
        otherwise = self._otherwise()
        if not seen.otherwise or seen.otherwise[-1][1] != otherwise:
            seen.otherwise.append((now, otherwise))
        for frame in frames:
            if frame.can_id == EMCY_ID + seen.node_id:
                code = int.from_bytes(frame.data[:2], "little")
                if code:
                    seen.emergencies.append((now, code))
        return frames

    def _otherwise(self) -> str:
        """By the drive's own state and by the torque that is in force in it."""
        drive = self._drive.drive
        objects, word = drive.objects, int(drive.objects.statusword.value)
        if drive.power.state is not State.OPERATION_ENABLED:
            return FOLLOWS
        if objects.mode_display.value != Mode.CYCLIC_SYNCHRONOUS_TORQUE:
            return OTHER_MODE
        if not word & (Status.FOLLOWS_COMMAND | Status.INTERNAL_LIMIT_ACTIVE):
            return TARGET_IGNORED
        asked_nm = (objects.target_torque.value + objects.torque_offset.value) * objects.torque_unit_nm
        off_nm = abs(drive.firmware.torque_demand_nm - asked_nm)
        if off_nm <= TORQUE_UNITS * objects.torque_unit_nm or word & Status.INTERNAL_LIMIT_ACTIVE:
            return FOLLOWS
        far_nm = FAR_UNITS * objects.torque_unit_nm + FAR_SHARE * abs(asked_nm)
        return FAR_TORQUE if off_nm > far_nm else OTHER_TORQUE


@contextmanager
def witnessed(
    witnesses: list[DriveWitness], witness: Callable[[SimulatedServo], DriveWitness] = DriveWitness
) -> Iterator[None]:
    """Every drive that a bench simulates in this process has one of ``witnesses`` while the context lasts."""
    inner = vars(bench)["open_world"]

    @contextmanager
    def open_world(plan: WorldPlan, devices: Sequence[Any]) -> Iterator[World]:
        watched: list[Any] = []
        for device in devices:
            if isinstance(device, SimulatedServo):
                witnesses.append(witness(device))
                watched.append(witnesses[-1])
            else:
                watched.append(device)
        with inner(plan, watched) as made:
            yield made

    with patch.object(bench, "open_world", open_world):
        yield
