"""Regular frames, and surplus frames between two of them (core/regular_stream.c, core/answers.c).

A drive answers each SYNC once, and sends its heartbeat, or a TPDO of which nothing changes, by a timer. While
a stream was regular for long enough, a frame is one too many if the next one comes in its own time as if it
had not been there.
"""

from collections.abc import Callable
from enum import IntEnum
from typing import Final, NamedTuple

from servobench.drivers.canopen.pdo import PdoMap
from servobench.drivers.canopen.sdo import Owed
from servobench.drivers.timebase import NEVER, Duration, Instant
from servobench.hil.core.native import RegularStream
from servobench.hil.loop.syncs import REMEMBERED, SyncLog

REGULAR: Final = 64
"""SYNCs that must have been answered in order before a surplus frame is reported: a frame held back for
longer than so many periods counts as lost in any bench."""
REGULAR_IN_TIME: Final = 2
"""The same where all readings that are remembered were sampled less than a period before they came, and no
SYNC had two frames for :data:`QUIET_SYNCS`: then a frame that is missing was lost, and not held back."""
QUIET_SYNCS: Final = 2000
"""A fault that holds one frame in two hundred back would have shown ten times."""
REGULAR_TIMED: Final = 2
"""The same of a stream by timer, whose next frame has to come where it was due."""
TOLERANCE: Final = 40
"""A frame by timer is in time within this part of its period: delays by a busy bus."""


class DelaysKnown(IntEnum):
    """Knowledge about the delays of a drive's readings."""

    UNKNOWN = 0
    """Or some are longer than a period."""
    SHORT = 1
    """Most are shorter than a period."""
    ALL_SHORT = 2
    """All are, of a thousand or so, by the drive's stamps."""


class Extra(NamedTuple):
    """A surplus frame."""

    at: Instant
    data: bytes


def _extras(pairs: list[tuple[Instant, bytes]]) -> list[Extra]:
    return [Extra(at, data) for at, data in pairs]


class TimedStream:
    """Frames by a timer of ``period``."""

    def __init__(self, period: Duration, *, repeats: bool) -> None:
        tolerance = period // TOLERANCE
        self._stream = RegularStream(period, tolerance, REGULAR_TIMED, 0, repeats, not repeats)

    def take(self, data: bytes, at: Instant) -> list[Extra]:
        """Take a frame; return the surplus ones before it."""
        return _extras(self._stream.take(at, 0, data, at))


class SyncedStream:
    """Compares the frames of a synchronous TPDO with the SYNCs of its segment."""

    def __init__(
        self,
        pdo: PdoMap,
        take_frames: Callable[[int], bytes],
        syncs: SyncLog,
        period: Duration,
        delays: Callable[[], DelaysKnown],
    ) -> None:
        """``take_frames``: by COB-ID, those that came since the last call, in rows. ``period``: of the SYNCs.
        ``delays``: of the drive's readings, asked at each look: one that was longer than a period and then
        is not brings two frames for one SYNC."""
        self._frames_of, self._syncs, self._delays = take_frames, syncs, delays
        self._period = period
        self._cob_id = pdo.cob_id
        self._each = max(1, pdo.transmission_type)
        self._owed = Owed(REMEMBERED + self._each)
        self._owed.expect(2 * self._each)  # one under way, and the phase of one that comes seldom
        self._stream = RegularStream(self._each, 0, REGULAR, period, False, False)
        self._told = 0
        self._were = DelaysKnown.UNKNOWN
        self._quiet_since = syncs.counted
        self._stream.seen = syncs.marks[-1].place if syncs.marks else 0
        self._counted = syncs.counted + syncs.missing
        if self._each == 1:
            self._stream.trust(self._stream.seen + 1)

    def look(self, *, at_end: bool = False) -> tuple[list[Extra], int]:
        """Return the frames since the last call that no SYNC requested: known frames, and how many more there
        are than SYNCs. Call it before too many SYNCs are forgotten; ``at_end``: no more come."""
        quiet = self._syncs.counted - self._quiet_since >= QUIET_SYNCS and self._were is DelaysKnown.ALL_SHORT
        self._stream.least, self._stream.doubled = REGULAR_IN_TIME if quiet else REGULAR, False
        self._stream.held = not quiet or self._syncs.of_another
        frames = self._frames_of(self._cob_id)
        pairs, came = self._stream.compare(frames, self._syncs.marks, self._known_until(at_end))
        extras = _extras(pairs + self._stream.end() if at_end else pairs)
        were, self._were = self._were, self._delays()
        settled = were and (self._were or not at_end)  # at the end nothing more answers an open question
        found = extras if settled else []
        if self._stream.doubled and not found:
            self._quiet_since = self._syncs.counted
        counted = self._syncs.counted + self._syncs.missing
        more = came * self._each - (counted - self._counted)
        self._counted = counted
        self._owed.expect(max(0, -more))
        self._owed.came(max(0, more))
        self._told += len(found)
        beyond = -(-self._owed.surplus // self._each) - self._told - self._stream.repetitions
        self._told += max(0, beyond)
        return found, max(0, beyond)

    def _known_until(self, at_end: bool) -> Instant:
        """Return the instant until which all SYNCs that a frame may answer are known. Later frames wait: a
        foreign SYNC that is still to come shows whether one was lost before them."""
        if not self._syncs.of_another:
            return NEVER
        return Instant(self._syncs.last_on_bus + (self._period if at_end else 0))
