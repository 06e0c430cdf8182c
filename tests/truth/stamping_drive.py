"""A simulated drive whose 1013h is coarser than a microsecond, and latched after the SYNC.

It stands between a tap and the drive, and rewrites the stamp in each TPDO that carries one.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any, Final

from drivers.timebase import NS_PER_US, Instant
from tests.truth.taps import SYNC_ID, Field, all_places
from virtual_bus.drive.servo import SimulatedServo
from virtual_bus.frame import Frame

STAMP: Final = 0x1013
_WRAP: Final = 1 << 32


@dataclass(frozen=True, slots=True)
class StampModel:
    """How a drive makes its stamps."""

    resolution_us: int = 1
    late_us: float = 0.0
    """The stamp is latched up to so much after the SYNC, or after the change that an event tells."""


EXACT: Final = StampModel()


class StampingDrive:
    """``drive`` with the stamps of ``model``."""

    def __init__(self, drive: SimulatedServo, model: StampModel, seed: int) -> None:
        self._drive = drive
        self._model = model
        self._draw = Random(f"stamps {seed} {drive.node_id}")
        self._places: list[Field] | None = None
        """Known from the first SYNC on: a drive is mapped before it is operational."""

    def __getattr__(self, name: str) -> Any:
        """The rest is the drive's own."""
        return getattr(self._drive, name)

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """See :class:`virtual_bus.frame.Device`."""
        answers = self._drive.receive(frame, now)
        if self._places is None and frame.can_id == SYNC_ID and answers:
            self._places = all_places(self._drive.dictionary, STAMP)
        return list(self._stamped(answers, now)) if answers else answers

    def wake(self, now: Instant) -> Sequence[Frame]:
        """See :class:`virtual_bus.frame.Device`."""
        answers = self._drive.wake(now)
        return list(self._stamped(answers, now)) if answers else answers

    def _stamped(self, frames: Sequence[Frame], now: Instant) -> Iterator[Frame]:
        for frame in frames:
            place = next((place for place in self._places or () if place.can_id == frame.can_id), None)
            yield frame if place is None else _with(frame, place, self._stamp(now))

    def _stamp(self, now: Instant) -> int:
        model = self._model
        late_ns = round(self._draw.random() * model.late_us * NS_PER_US)
        shown_us = (self._drive.clock.local_ns(now) + late_ns) // NS_PER_US
        return shown_us // model.resolution_us * model.resolution_us % _WRAP


def _with(frame: Frame, place: Field, value: int) -> Frame:
    """``frame`` with ``value`` in ``place``."""
    end, data = place.first_byte + place.bytes, frame.data
    return Frame(frame.can_id, data[: place.first_byte] + value.to_bytes(place.bytes, "little") + data[end:])
