"""Kernel and adapter stamps of a frame, converted to the bench's axis. No I/O.

The kernel stamps with the wall clock, which can be set; the adapter with a counter of its own. Both are
mapped to the monotonic clock here:

    ancillary data --> software stamp --> WallStamps ------------------------------> instant
                   \\-> hardware stamp ---------------> AdapterClock(instant) ------> instant, closer
"""

import socket
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from struct import Struct
from typing import Final, NamedTuple

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant

SO_TIMESTAMPNS: Final = 35
SO_TIMESTAMPING: Final = 37
SO_RXQ_OVFL: Final = 40
"""Kernel options, and the types of the ancillary data that they bring (asm-generic/socket.h)."""
SO_TIMESTAMPNS_NEW: Final = 64
SO_TIMESTAMPING_NEW: Final = 65
"""The same with 64-bit times, as 32-bit programs that were built for them get it."""
HARDWARE_STAMPS: Final = 1 << 2 | 1 << 6
"""SOF_TIMESTAMPING_RX_HARDWARE | SOF_TIMESTAMPING_RAW_HARDWARE (linux/net_tstamp.h). A CAN driver's transmit
stamp is the receive stamp of the frame's echo, so SOF_TIMESTAMPING_TX_HARDWARE, which reports by the error
queue, adds nothing."""

_TIMESPECS: Final = (Struct("=qq"), Struct("=ii"))
"""struct timespec of 64-bit programs, and the old one of 32-bit programs, told apart by length."""
_STAMPINGS: Final = (Struct("=qqqqqq"), Struct("=iiiiii"))
"""struct scm_timestamping: software, (unused), raw hardware."""
_OVERFLOW: Final = Struct("=I")
ANCILLARY_BYTES: Final = sum(map(socket.CMSG_SPACE, (_TIMESPECS[0].size, _STAMPINGS[0].size, _OVERFLOW.size)))
Ancillary = Sequence[tuple[int, int, bytes]]

REORDERED_MAX_NS: Final = NS_PER_MS
"""How much earlier than the frame in front of it a frame may have been stamped: the kernel stamps in the
adapter's interrupt, and one processor's queue may be served later than another's."""
_BLOCK_NS: Final = 100 * NS_PER_MS
"""A hundred frames of a 1 kHz cycle, of which the one that was quickest to its software stamp counts; a
quartz that is 100 ppm off drifts 10 us meanwhile."""
_BLOCKS: Final = 32
"""3.2 s: long for a rate from instants that are good to some us, short for a quartz that warms up."""
_RESTARTED_NS: Final = 100 * NS_PER_MS
"""Longer than any adapter takes to hand over a frame: a counter that disagrees by more has been set anew."""
FAR_OFF_NS: Final = NS_PER_S
"""A kernel stamp this far before the previous frame, or after now, does not belong to this clock; a wall
clock that was set is recognised by the comparisons."""
_RESTARTS_MAX: Final = 3
"""Restarts of a counter without a block of agreement between them: its stamps of own and of others' frames
then count from different starts."""


class FrameStamps(NamedTuple):
    """The ancillary data of one frame."""

    software_ns: int | None
    """On the wall clock."""
    hardware_ns: int | None
    """On the adapter's own clock."""
    lost_frames: int | None
    """Dropped so far because the receive buffer was full."""


def parse_ancillary(ancillary: Ancillary) -> FrameStamps:
    """Parse the ancillary data; None for a value that is missing, or zero as the kernel leaves it."""
    software = hardware = lost = None
    for _, kind, value in ancillary:
        if kind in (SO_TIMESTAMPNS, SO_TIMESTAMPNS_NEW):
            software = _last_time(value, _TIMESPECS)
        elif kind in (SO_TIMESTAMPING, SO_TIMESTAMPING_NEW):
            hardware = _last_time(value, _STAMPINGS) or None
        elif kind == SO_RXQ_OVFL and len(value) >= _OVERFLOW.size:
            (lost,) = _OVERFLOW.unpack_from(value)
    return FrameStamps(software, hardware, lost)


def _last_time(value: bytes, layouts: Sequence[Struct]) -> int | None:
    """Return the last time in ``value``, ns; None if its length fits no layout."""
    for layout in layouts:
        if len(value) == layout.size:
            *_, seconds, ns = layout.unpack(value)
            return int(seconds * NS_PER_S + ns)
    return None


class _Offset:
    """Wall clock minus monotonic clock between two settings: constant, as the kernel slews both alike."""

    def __init__(self, before: int, wall: int, after: int) -> None:
        self.lowest, self.highest = wall - after, wall - before
        """ns: the range left by all comparisons."""
        self.since_at_latest = after
        self.until_at_earliest = before

    def agrees(self, before: int, wall: int, after: int) -> bool:
        """Narrow it down by one more comparison; False if that contradicts, so that the clock was set."""
        lowest, highest = max(self.lowest, wall - after), min(self.highest, wall - before)
        if lowest > highest:
            return False
        self.lowest, self.highest, self.until_at_earliest = lowest, highest, before
        return True

    @property
    def value(self) -> int:
        """The middle of that range, ns."""
        return (self.lowest + self.highest) // 2


class WallStamps:
    """Maps the wall-clock stamps of a queue of frames to the monotonic clock, also while that clock is set.

    A frame stamped before a step belongs to the offset before it, even if read later. Each offset was in
    force from some instant after the last comparison that found the one before it, until some instant before
    the first that found the next. A frame gets the oldest offset that puts it there, not before the frame in
    front of it or the instant at which the queue was empty, and not after now; once a frame has a later
    offset, so have all behind it.

    A step smaller than the time since the last comparison cannot be recognised: a stamp may then be wrong by
    the step.
    """

    def __init__(self) -> None:
        self.far_off = 0
        """Stamps not used because they lay far outside of the possible range."""
        self._offsets: list[_Offset] = []
        self._floor = 0
        """No frame to come was stamped before this."""

    def compare(self, before: int, wall: int, after: int) -> None:
        """Compare the clocks: the wall clock was read between two readings of the monotonic clock, ns."""
        if not self._offsets or not self._offsets[-1].agrees(before, wall, after):
            self._offsets.append(_Offset(before, wall, after))

    def emptied(self, at: int) -> None:
        """Note that the queue was found empty at ``at``."""
        while len(self._offsets) > 1 and self._offsets[1].since_at_latest <= at:
            del self._offsets[0]
        self._floor = max(self._floor, at - REORDERED_MAX_NS)

    def instant(self, stamp_ns: int, now: int) -> Instant:
        """Return when the next frame of the queue was stamped. Call :meth:`compare` at ``now`` first."""
        offsets = self._offsets
        for number, offset in enumerate(offsets):
            at = stamp_ns - offset.value
            since = offsets[number - 1].until_at_earliest if number else 0
            until = offsets[number + 1].since_at_latest if number + 1 < len(offsets) else now
            if max(self._floor, since) <= at <= until:
                del offsets[:number]
                break
        else:
            at = stamp_ns - offsets[-1].value
            if not self._floor - FAR_OFF_NS <= at <= now + FAR_OFF_NS:
                self.far_off += 1
                at = now
            at = min(max(at, self._floor), now)
        self._floor = max(self._floor, at - REORDERED_MAX_NS)
        return Instant(at)


class AdapterClock:
    """The adapter's counter on the monotonic clock: offset and rate from pairs of stamps of the same frames.

    The software stamp comes later than the hardware's by the way from the adapter to the kernel, now more,
    now less. So the line under all points (hardware, software - hardware) is sought that is closest to them:
    the edge of their lower hull below their middle. A constant part of that delay stays in the stamps.

    Tested on made-up stamps only: it was never run on an adapter.
    """

    def __init__(self) -> None:
        self._blocks: deque[tuple[int, int]] = deque(maxlen=_BLOCKS)
        """The lowest point of each block of time."""
        self.useless = False
        """True if its stamps jump so often that they are not used any more."""
        self._restarts = 0
        self._block_ends = 0
        self._last = 0

    def instant(self, hardware_ns: int, software_at: Instant) -> Instant:
        """Return when the adapter stamped a frame that the kernel stamped at ``software_at``; never after
        that."""
        if self.useless:
            return software_at
        late = software_at - hardware_ns
        if self._blocks and (
            hardware_ns < self._last - REORDERED_MAX_NS
            or abs(late - self._lateness_min(hardware_ns)) > _RESTARTED_NS
        ):
            self._blocks.clear()
            self._restarts += 1
            self.useless = self._restarts > _RESTARTS_MAX
        if not self._blocks or hardware_ns > self._last:
            self._note(hardware_ns, late)
            self._last = hardware_ns
        return Instant(min(hardware_ns + self._lateness_min(hardware_ns), software_at))

    def _note(self, hardware_ns: int, late: int) -> None:
        if not self._blocks or hardware_ns >= self._block_ends:
            if self._blocks:
                self._restarts = 0
            self._blocks.append((hardware_ns, late))
            self._block_ends = hardware_ns + _BLOCK_NS
        elif late < self._blocks[-1][1]:
            self._blocks[-1] = (hardware_ns, late)

    def _lateness_min(self, hardware_ns: int) -> int:
        """Return the height of the line at ``hardware_ns``."""
        hull = _lower_hull(self._blocks)
        middle = sum(x for x, _ in self._blocks) // len(self._blocks)
        for (x0, y0), (x1, y1) in pairwise(hull):
            if x1 >= middle:
                return y0 + (y1 - y0) * (hardware_ns - x0) // (x1 - x0)
        return hull[0][1]


def _lower_hull(points: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the points of the lower convex hull (Andrew's monotone chain). x: ascending."""
    hull: list[tuple[int, int]] = []
    for x, y in points:
        while len(hull) >= 2 and _turns_down(hull[-2], hull[-1], (x, y)):
            hull.pop()
        hull.append((x, y))
    return hull


def _turns_down(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])
