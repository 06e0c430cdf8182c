"""Regular frames, and surplus frames between two of them.

A drive answers each SYNC once, and sends its heartbeat, or a TPDO of which nothing changes, by a timer. While
a stream was regular for long enough, a frame is one too many if the next one comes in its own time as if it
had not been there:

    place     61   62   63   64 64   65      a SYNC each, or a time
    frames    a    b    c    d  x    e       x: nobody asked for it

Of two frames of one SYNC that is taken for the extra one whose delay is less usual. One that equals another
of the last frames is no news: a bus, an adapter or a gateway may repeat it.

Where the answer to the next SYNC was lost, and not held back, the one after that proves the same of frames
that came too early to answer it.

The next one proves nothing if its delay is off the usual one by more than half a period, or is rather that of
the frame in question. Then answers have changed sides of their SYNCs: they take about a period, or took more
and now take less, or a SYNC not heard was elsewhere than thought.
"""

from collections import deque
from collections.abc import Callable, Iterator
from enum import IntEnum
from itertools import pairwise
from typing import Final, NamedTuple

from servobench.drivers.canopen.owed import Owed
from servobench.drivers.canopen.pdo import PdoMap
from servobench.drivers.timebase import NEVER, Duration, Instant
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
"""A frame by timer is in time within this part of its period, and one that answers a SYNC comes as usual
within this part of a period: delays by a busy bus."""
RECENT: Final = 32
"""Frames of which another one may be a repetition."""
REPEATS: Final = 2
"""This many repetitions mark a network that repeats frames. A single one may be an equal answer beside a
stranger's frame."""
LEARNT: Final = 8
"""Frames over which the usual delay is averaged: a gateway's new one is learnt within ten periods."""
EXTRAS_MAX: Final = 16
"""More between two regular frames are a flood, which is counted against the SYNCs."""


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


class _Frame:
    __slots__ = ("at", "data", "delay", "repeated")

    def __init__(self, at: Instant, data: bytes, delay: int, repeated: bool) -> None:
        self.at = at
        self.data = data
        self.delay = delay
        self.repeated = repeated


class RegularStream:
    """One such stream: frames whose places are ``step`` apart, within ``tolerance``."""

    def __init__(
        self,
        step: int,
        tolerance: int = 0,
        least: int = REGULAR,
        *,
        period: int = 0,
        repeats: bool = False,
        same: bool = False,
    ) -> None:
        """``least``: regular frames before an extra one. ``period``: of the SYNCs that are answered.
        ``repeats``: frames are all alike. ``same``: the regular frame after an extra one must be as the one
        before."""
        self.last: int | None = None
        """Place of the last regular frame."""
        self.regular = 0
        """Frames that came in order."""
        self.least = least
        self.repetitions = 0
        """Frames too many that may be repetitions of one before; in a network that repeats frames, all that
        equal one of the last."""
        self.held = True
        """True if a missing frame may have been held back, and still come."""
        self.doubled = False
        """Since this was last set back there was more than one frame where one was due."""
        self._step, self._tolerance = step, tolerance
        self._repeats, self._same, self._half = repeats, same, period / 2.0
        self._noise = period / TOLERANCE
        self._recent: deque[bytes] = deque(maxlen=RECENT)
        self._times: dict[bytes, int] = {}
        """Count of each of them: comparing with all 32 would cost more than everything else."""
        self._counted = True
        """True if they were counted when the last one came; without a need they are not."""
        self._usual = 0.0
        self._frame = _Frame(Instant(0), b"", 0, False)
        self._extras: list[_Frame] = []

    def trust(self, place: int) -> None:
        """Expect the frame at ``place`` next: nothing was ever lost."""
        self.last, self.regular = place - self._step, self.least

    def take(self, place: int, delay: int, data: bytes, at: Instant) -> list[Extra]:
        """Take a frame, ``delay`` after what it answers; return the surplus ones before it."""
        frame = _Frame(at, data, delay, not self._repeats and self._is_known(data))
        last = self.last
        moved = self._step if last is None else place - last
        extra = 0 <= moved < self._step
        repetition = frame.repeated and self.repeating
        lost = moved > self._step and not self.held and not any(map(self._is_on_other_side, self._extras))
        if abs(moved - self._step) <= self._tolerance or (lost and self._extras):
            self._remember(data)
            found = self._found(frame) if self._extras else []
            self.last, self._frame = place, frame
            self.regular = 0 if repetition or lost else self.regular + 1
            self.repetitions += repetition
            self._usual += (delay - self._usual) / LEARNT
            return found
        if extra:
            self.doubled = True
            repetition = frame.repeated or (self._frame.repeated and not self.repeating)
        self.repetitions += repetition
        if extra and self.regular >= self.least and len(self._extras) < EXTRAS_MAX:
            if not moved and abs(delay - self._usual) < abs(self._frame.delay - self._usual):
                frame, self._frame = self._frame, frame
                self._remember(data)
            if not frame.repeated:
                self._extras.append(frame)
            return []
        self._clear_of_doubt()
        self._remember(data)
        self.last, self._frame, self.regular = place, frame, 0
        return []

    def pass_over(self, places: range, delay: int, frames: list[bytes]) -> None:
        """Take frames, one for each of ``places``, which follow the last; ``delay``: their mean."""
        self.last = places[-1]
        self.regular += len(places)
        self._recent.extend(frames)
        self._counted = False
        self._usual += (delay - self._usual) * min(len(places) / LEARNT, 1.0)
        self._frame = _Frame(Instant(0), frames[-1], delay, False)

    def end(self) -> list[Extra]:
        """End the stream: frames since the last regular one are surplus."""
        if self._frame.repeated and self.repeating:
            self._clear_of_doubt()
        self._extras = [frame for frame in self._extras if not self._is_on_other_side(frame)]
        return self._take_extras()

    @property
    def repeating(self) -> bool:
        """True if the network repeats frames: then one equal to a recent one proves no answer."""
        return self.repetitions >= REPEATS

    @property
    def calm(self) -> bool:
        """True if no surplus frame is suspected."""
        return not self._extras

    def _remember(self, data: bytes) -> None:
        """Add to the recent frames."""
        recent, times = self._recent, self._times
        if self._counted:
            if len(recent) == RECENT:
                oldest = recent[0]
                if times[oldest] == 1:
                    del times[oldest]
                else:
                    times[oldest] -= 1
            times[data] = times.get(data, 0) + 1
        recent.append(data)

    def _is_known(self, data: bytes) -> bool:
        """Return True if one of the recent frames had it, suspected or not."""
        if not self._counted:
            self._times = {}
            for each in self._recent:
                self._times[each] = self._times.get(each, 0) + 1
            self._counted = True
        if data in self._times:
            return True
        for frame in self._extras:  # noqa: SIM110 - a generator costs more than all else here
            if frame.data == data:
                return True
        return False

    def _is_on_other_side(self, frame: _Frame) -> bool:
        """Return True if a frame is likelier the usual answer of a period before or after."""
        return abs(frame.delay - self._usual) > self._half

    def _is_as_extras(self, frame: _Frame) -> bool:
        """Return True if a frame is as late as a suspected one, and not as usual."""
        off = abs(frame.delay - self._usual)
        return off > self._noise and any(abs(frame.delay - each.delay) < off for each in self._extras)

    def _found(self, frame: _Frame) -> list[Extra]:
        """Return the surplus frames before ``frame``, a regular one."""
        before = self._frame
        back = frame.data == before.data
        if (self._same and not back) or (before.repeated and (self.repeating or not back)):
            self._clear_of_doubt()
        if self._is_on_other_side(frame) or self._is_as_extras(frame):
            self._clear_of_doubt()
        if before.repeated:
            self.repetitions -= len(self._extras)
        return self._take_extras()

    def _take_extras(self) -> list[Extra]:
        extras, self._extras = self._extras, []
        return [Extra(frame.at, frame.data) for frame in extras]

    def _clear_of_doubt(self) -> None:
        """Clear the suspected frames: they are genuine, and may be repeated like any frame."""
        for frame in self._extras:
            self._remember(frame.data)
        self._extras.clear()


class TimedStream:
    """Frames by a timer of ``period``."""

    def __init__(self, period: Duration, *, repeats: bool) -> None:
        tolerance = period // TOLERANCE
        self._stream = RegularStream(period, tolerance, REGULAR_TIMED, repeats=repeats, same=not repeats)

    def take(self, data: bytes, at: Instant) -> list[Extra]:
        """Take a frame; return the surplus ones before it."""
        return self._stream.take(at, 0, data, at)


class SyncedStream:
    """Compares the frames of a synchronous TPDO with the SYNCs of its segment."""

    def __init__(
        self,
        pdo: PdoMap,
        take_frames: Callable[[int], list[tuple[bytes, Instant]]],
        syncs: SyncLog,
        period: Duration,
        delays: Callable[[], DelaysKnown],
    ) -> None:
        """``take_frames``: by COB-ID, those that came since the last call. ``period``: of the SYNCs.
        ``delays``: of the drive's readings, asked at each look: one that was longer than a period and then
        is not brings two frames for one SYNC."""
        self._frames_of, self._syncs, self._delays = take_frames, syncs, delays
        self._period = period
        self._behind: list[tuple[bytes, Instant]] = []
        """Frames after the last foreign SYNC: the next one shows whether one was lost before them."""
        self._cob_id = pdo.cob_id
        self._each = max(1, pdo.transmission_type)
        self._owed = Owed(REMEMBERED + self._each)
        self._owed.expect(2 * self._each)  # one under way, and the phase of one that comes seldom
        self._stream = RegularStream(self._each, period=period)
        self._told = 0
        self._were = DelaysKnown.UNKNOWN
        self._quiet_since = syncs.counted
        self._seen = syncs.marks[-1].place if syncs.marks else 0
        self._counted = syncs.counted + syncs.missing
        if self._each == 1:
            self._stream.trust(self._seen + 1)

    def look(self, *, at_end: bool = False) -> tuple[list[Extra], int]:
        """Return the frames since the last call that no SYNC requested: known frames, and how many more there
        are than SYNCs. Call it before too many SYNCs are forgotten; ``at_end``: no more come."""
        until = self._known_until(at_end)
        frames = self._take_frames(until)
        quiet = self._syncs.counted - self._quiet_since >= QUIET_SYNCS and self._were is DelaysKnown.ALL_SHORT
        self._stream.least, self._stream.doubled = REGULAR_IN_TIME if quiet else REGULAR, False
        self._stream.held = not quiet or self._syncs.of_another
        extras = [*self._extras(frames, until), *(self._stream.end() if at_end else ())]
        were, self._were = self._were, self._delays()
        settled = were and (self._were or not at_end)  # at the end nothing more answers an open question
        found = extras if settled else []
        if self._stream.doubled and not found:
            self._quiet_since = self._syncs.counted
        counted = self._syncs.counted + self._syncs.missing
        more = len(frames) * self._each - (counted - self._counted)
        self._counted = counted
        self._owed.expect(max(0, -more))
        self._owed.came(max(0, more))
        self._told += len(found)
        beyond = -(-self._owed.surplus // self._each) - self._told - self._stream.repetitions
        self._told += max(0, beyond)
        return found, max(0, beyond)

    def _known_until(self, at_end: bool) -> Instant:
        """Return the instant until which all SYNCs that a frame may answer are known."""
        if not self._syncs.of_another:
            return NEVER
        return Instant(self._syncs.last_on_bus + (self._period if at_end else 0))

    def _take_frames(self, until: Instant) -> list[tuple[bytes, Instant]]:
        """Take the frames to compare with the SYNCs now; later ones wait."""
        frames = [*self._behind, *self._frames_of(self._cob_id)]
        self._behind = [frame for frame in frames if frame[1] >= until][-REMEMBERED:]
        return [frame for frame in frames if frame[1] < until]

    def _extras(self, frames: list[tuple[bytes, Instant]], until: Instant) -> list[Extra]:
        starts = [
            (at, mark.place)
            for mark in self._syncs.marks
            if mark.place >= self._seen
            and (at := mark.handed_at if mark.on_bus_at is None else mark.on_bus_at) < until
        ]
        if starts and starts[-1][1] - starts[0][1] >= len(starts):
            starts = [*_with_missing(starts)]
        found: list[Extra] = []
        if self._passes(starts, frames):
            return found
        place = 0
        for data, at in frames:
            while place + 1 < len(starts) and starts[place + 1][0] <= at:
                place += 1
            if starts and starts[place][0] <= at:
                self._seen = starts[place][1]
                found += self._stream.take(self._seen, at - starts[place][0], data, at)
        return found

    def _passes(self, starts: list[tuple[Instant, int]], frames: list[tuple[bytes, Instant]]) -> bool:
        """Return True if each SYNC since the last look has its one frame, which is nearly always so."""
        stream, new = self._stream, starts[1:]
        if not frames or self._each > 1 or len(new) != len(frames) or not stream.calm or stream.repeating:
            return False
        if starts[0][1] != self._seen or stream.last != self._seen:
            return False
        delays, before = 0, new[0][0] - 1
        for place, (begun, _) in enumerate(new):
            came = frames[place][1]
            if begun <= before or came <= begun:
                return False
            delays += came - begun
            before = came
        first, self._seen = self._seen + 1, new[-1][1]
        stream.pass_over(range(first, self._seen + 1), delays // len(new), [data for data, _ in frames])
        return True


def _with_missing(starts: list[tuple[Instant, int]]) -> Iterator[tuple[Instant, int]]:
    """Yield ``starts``, and between them missing SYNCs at equal distances."""
    yield starts[0]
    for (before_at, before), (at, place) in pairwise(starts):
        for number in range(before + 1, place) if place - before <= REMEMBERED else ():
            yield Instant(before_at + (at - before_at) * (number - before) // (place - before)), number
        yield at, place
