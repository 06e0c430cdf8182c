"""Frames that wait in front of a bus whose own transmit queue is full, or whose interface is down.

first     NMT: a stop is not to wait behind anything
then      SYNC, PDOs, EMCY, TIME, error control: in the order of their hand-over; of one identifier the
          newest alone, as an older one would reach its node late, and several in a burst
last      SDO and LSS requests: in the order of their hand-over
"""

import errno
from collections import deque
from collections.abc import Container
from typing import Final

import can

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration, Instant
from servobench.drivers.wire.frame_port import WireFrame

NO_ROOM: Final = frozenset({errno.ENOBUFS, errno.EAGAIN, errno.ENETDOWN})
"""Errors of a bus that may take the same frame later. ENETDOWN: a SocketCAN socket works again once its
interface is up."""
RETRY_EVERY: Final = Duration(130 * NS_PER_US)
"""A frame of 8 bytes at 1 Mbit/s: no room becomes free faster for long."""
RETRY_AT_MOST: Final = Duration(NS_PER_MS)
"""Limit after 4 ms without room. Drivers of serial adapters free their queue in a kernel thread, to which a
bench with real-time priority on one processor must leave time: at 130 us it never ran. Gaps differ by up to a
half: retries in step with another program that sends as regularly would meet its frames alone."""
_SPREAD: Final = 0.618033988749895
"""Golden ratio: its multiples, less their whole parts, lie evenly over any stretch of retries."""
STUCK_AFTER: Final = Duration(NS_PER_S)
"""No queue of a sound bus stands still for ten thousand frames. A watched drive stops by itself before."""
ROOM: Final = 512
"""Requests: each node has one under way, and each master's search as many."""

_SDO_FIRST, _SDO_LAST = 0x580, 0x67F
_LSS_FIRST, _LSS_LAST = 0x7E4, 0x7E5


class SendQueue:
    """The frames of one link that its bus did not take yet."""

    def __init__(self) -> None:
        self.blocked_since = Instant(0)
        """When the bus last took a frame, or the first of these began to wait."""
        self.given_up = 0
        """Frames never sent: a newer one with their identifier came, or it was too late."""
        self._retries = 0
        self._classes: tuple[deque[WireFrame], ...] = (deque(), deque(), deque())

    def __len__(self) -> int:
        return sum(map(len, self._classes))

    def put(self, frame: WireFrame, now: Instant) -> WireFrame | None:
        """Queue ``frame``. Returns the one that it replaces, which is never sent.

        Raises can.CanOperationError if there are too many requests already.
        """
        if not self:
            self.blocked_since = now
        can_id = frame.can_id
        if _SDO_FIRST <= can_id <= _SDO_LAST or _LSS_FIRST <= can_id <= _LSS_LAST:
            if len(self._classes[2]) >= ROOM:
                raise can.CanOperationError(f"{ROOM} requests wait already", errno.ENOBUFS)
            self._classes[2].append(frame)
            return None
        if not can_id:
            self._classes[0].append(frame)
            return None
        waiting = self._classes[1]
        older = next((one for one in waiting if (one.can_id, one.remote) == (can_id, frame.remote)), None)
        if older is not None:
            waiting.remove(older)
            self.given_up += 1
        waiting.append(frame)
        return older

    def first(self) -> WireFrame | None:
        """Return the frame due next; it stays until :meth:`went`."""
        for waiting in self._classes:
            if waiting:
                return waiting[0]
        return None

    def retry_at(self, now: Instant) -> Instant:
        """Return when to offer a refused frame again: the longer nothing was taken, the later."""
        self._retries += 1
        longest = min(RETRY_AT_MOST, (now - self.blocked_since) // 4)
        gap = round(longest * (1.0 - 0.5 * (self._retries * _SPREAD % 1.0)))
        return Instant(now + max(RETRY_EVERY, gap))

    def went(self, now: Instant) -> None:
        """Remove the first one: the bus took it."""
        self.blocked_since = now
        self._take_first()

    def withdraw(self, can_ids: Container[int]) -> list[WireFrame]:
        """Discard the frames of ``can_ids``, except NMT and requests; return them."""
        waiting = self._classes[1]
        withdrawn = [frame for frame in waiting if frame.can_id in can_ids]
        for frame in withdrawn:
            waiting.remove(frame)
        self.given_up += len(withdrawn)
        return withdrawn

    def drop(self) -> None:
        """Give up the first one."""
        self.given_up += 1
        self._take_first()

    def _take_first(self) -> None:
        next(waiting for waiting in self._classes if waiting).popleft()

    def stuck(self, now: Instant) -> bool:
        """Return True if the bus takes nothing any more."""
        return bool(self) and now - self.blocked_since > STUCK_AFTER
