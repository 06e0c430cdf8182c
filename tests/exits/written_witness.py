"""A witness of a drive that writes down at once what it sees: it is there after any process was killed."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from servobench.drivers.cia402.profile import State
from servobench.drivers.timebase import Duration, Instant
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from tests.swarm.invariants import REST_RAD_S
from tests.swarm.witness import DriveWitness, Testimony

SYNC_ID: Final = 0x080


class WrittenWitness(DriveWitness):
    """Stands in front of one simulated drive."""

    def __init__(self, drive: SimulatedServo, path: Path) -> None:
        super().__init__(drive)
        self._file = path.open("a", buffering=1)
        self._moving = False

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        if frame.can_id == SYNC_ID and self._drive.drive.power.state is State.OPERATION_ENABLED:
            self._write(now, cycle=True)
        return super().receive(frame, now)

    def _seen(self, frames: Sequence[Frame], now: Instant) -> Sequence[Frame]:
        known = len(self._seen_so_far.states)
        super()._seen(frames, now)
        seen = self.testimony()
        if len(seen.states) > known:
            self._write(now, state=seen.states[-1][1].value)
        moving = abs(seen.speed_rad_s) >= REST_RAD_S
        if moving is not self._moving:
            self._moving = moving
            self._write(now, speed_rad_s=seen.speed_rad_s)
        return frames

    def _write(self, at: Instant, **found: Any) -> None:
        self._file.write(json.dumps({"at": at, **found}) + "\n")


class WrittenTestimony(Testimony):
    """What such a witness has written; of the speed, when the shaft last began to move or came to rest."""

    def __init__(self, node_id: int, path: Path) -> None:
        text = path.read_text() if path.exists() else ""
        self._entries = [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]
        states = [(entry["at"], State(entry["state"])) for entry in self._entries if "state" in entry]
        speeds = [entry["speed_rad_s"] for entry in self._entries if "speed_rad_s" in entry]
        super().__init__(node_id, states, [], speed_rad_s=speeds[-1] if speeds else 0.0)

    @property
    def cycles(self) -> int:
        """SYNCs that it heard while it was enabled."""
        return sum("cycle" in entry for entry in self._entries)

    def time_to_rest(self, since: Instant) -> Duration | None:
        """From an instant until it is at rest and disabled for good; None: it never is."""
        rested_at: Instant | None = since
        for at, resting in self._changes():
            if not resting:
                rested_at = None
            elif rested_at is None:
                rested_at = max(at, since)
        return None if rested_at is None else Duration(rested_at - since)

    def _changes(self) -> Iterator[tuple[Instant, bool]]:
        """Whether it is at rest and disabled, from each instant on."""
        moving, state = False, None
        for entry in self._entries:
            moving = abs(entry["speed_rad_s"]) >= REST_RAD_S if "speed_rad_s" in entry else moving
            state = State(entry["state"]) if "state" in entry else state
            yield Instant(entry["at"]), not moving and state is not State.OPERATION_ENABLED
