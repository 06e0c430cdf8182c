"""Other nodes' traffic: streams of frames that nobody here wants, which take their share of the bus.

Each stream is a device of its own, with its own random stream, so that changing one leaves the others as
they were. On a simulated segment each has a port and competes for the bus as any node does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log
from typing import Final, Literal

from servobench.drivers.timebase import Duration, Instant
from servobench.virtual_bus.faults.fault_streams import uniform_stream
from servobench.virtual_bus.frame import Frame

CATCH_UP_MAX: Final = 64
"""Frames that a late wake-up sends at once; what was due beyond that is skipped and counted."""
_NO_JITTER: Final = Duration(0)
_NOTHING: tuple[Frame, ...] = ()


@dataclass(frozen=True, slots=True)
class Stream:
    """The frames of one identifier."""

    can_id: int
    period: Duration
    extended: bool = False
    remote: bool = False
    bytes_min: int = 8
    bytes_max: int = 8
    """The number of data bytes is even between the two; of a remote frame, its DLC."""
    jitter: Duration = _NO_JITTER
    """Each periodic frame comes up to so much later, evenly; the grid itself does not drift."""
    arrivals: Literal["periodic", "random"] = "periodic"
    """Random: a Poisson process with the period as mean distance."""

    def __post_init__(self) -> None:
        if not 0 <= self.can_id < 1 << (29 if self.extended else 11):
            raise ValueError(f"identifier 0x{self.can_id:X} does not fit")
        if self.period < 1 or not 0 <= self.jitter <= self.period:
            raise ValueError("the period must be positive and the jitter no longer")
        if not 0 <= self.bytes_min <= self.bytes_max <= 8:
            raise ValueError("0 to 8 bytes, bytes_min no more than bytes_max")


class BackgroundNode:
    """A device that sends ``stream`` and hears nothing; ``name`` and ``seed`` make its random stream."""

    def __init__(self, stream: Stream, seed: int, name: str) -> None:
        self.stream = stream
        self.skipped = 0
        """Frames that were not sent because the wake-up came far too late."""
        self.wake_at: Instant | None = None
        self._draw = uniform_stream(seed, f"background/{name}")
        self._grid = Instant(0)

    def start(self, now: Instant) -> Sequence[Frame]:
        """Power on: streams begin at a random place in their period."""
        self._grid = Instant(now + int(self._draw() * self.stream.period))
        self._plan(now)
        return _NOTHING

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """Nothing here reacts."""
        del frame, now
        return _NOTHING

    def wake(self, now: Instant) -> Sequence[Frame]:
        """The frames that are due."""
        frames: list[Frame] = []
        while self.wake_at is not None and self.wake_at <= now:
            if len(frames) < CATCH_UP_MAX:
                frames.append(self._frame())
            else:
                self.skipped += 1
            self._advance()
            self._plan(self.wake_at)
        return frames

    def _advance(self) -> None:
        period = self.stream.period
        if self.stream.arrivals == "random":
            self._grid = Instant(self._grid + max(round(-period * log(1.0 - self._draw())), 1))
        else:
            self._grid = Instant(self._grid + period)

    def _plan(self, last: Instant) -> None:
        """Enter the next frame, later than ``last`` (jitter as long as the period could make two meet)."""
        late = int(self._draw() * self.stream.jitter) if self.stream.jitter else 0
        self.wake_at = Instant(max(self._grid + late, last + 1))

    def _frame(self) -> Frame:
        stream = self.stream
        length = stream.bytes_min + int(self._draw() * (stream.bytes_max - stream.bytes_min + 1))
        if stream.remote:
            return Frame(stream.can_id, b"", stream.extended, True, length)
        data = int(self._draw() * 2.0**53) << 11 | int(self._draw() * 2048)
        return Frame(stream.can_id, data.to_bytes(8, "little")[:length], stream.extended)


def background_nodes(streams: Sequence[Stream], seed: int) -> list[BackgroundNode]:
    """One node a stream; a stream keeps its randomness while others are added behind it."""
    return [BackgroundNode(stream, seed, f"{place}") for place, stream in enumerate(streams)]
