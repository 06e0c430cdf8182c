"""Frames in and out of a bus, stamped on the bench's clock.

Frames that wait in front of a bus whose own transmit queue is full, or whose interface is down.

first     NMT: a stop is not to wait behind anything
then      SYNC, PDOs, EMCY, TIME, error control: in the order of their hand-over; of one identifier the
          newest alone, as an older one would reach its node late, and several in a burst
last      SDO and LSS requests: in the order of their hand-over
"""

import errno
from collections import deque
from collections.abc import Callable, Container
from typing import Final, NoReturn

import can

from servobench.drivers.core.native import Link
from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NEVER, NS_PER_MS, NS_PER_S, NS_PER_US, Clock, Duration, Instant
from servobench.drivers.wire.frame_port import CallbackTap, EchoBasis, FramePort, FrameTap, WireFrame
from servobench.drivers.wire.frame_port import Direction as Direction
from servobench.drivers.wire.frame_port import Tap as Tap
from servobench.drivers.wire.message_port import MessagePort
from servobench.drivers.wire.message_port import StampSource as StampSource

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


Received = tuple[int, bytes, Instant]
"""Identifier, data, and the bus's stamp of the frame."""
_STUCK: Final = "it has taken no frame for a second: its queue is full as nobody acknowledges, or it is down"


class BusLink(Link):
    """The one place through which a master's frames leave and arrive.

    Only data frames with an 11-bit identifier are handed on: CANopen uses no others. Remote frames and
    extended frames reach the tap and the count ``ignored_frames``, error frames the count ``error_frames``.

    A frame sent here comes back after the bus as an *echo* if the bus supports it (``echoes``). Echoes reach
    no tap and are not counted as received.

    A frame that the bus has no room for waits here (:mod:`servobench.drivers.wire.link`) and goes out
    while somebody receives. The tap sees it when the bus takes it. What is done for each frame is C
    (core/link.c).
    """

    def __init__(
        self, bus: can.BusABC, clock: Clock, stamps: StampSource = StampSource.RECEIPT, name: str = ""
    ) -> None:
        """``stamps``: the stamps of a bus without a ``frame_port``."""
        self.bus = bus
        self.name = name or str(getattr(bus, "channel_info", "") or type(bus).__name__)
        """The bus's name in errors."""
        self.on_unsent: Callable[[int, Instant], None] | None = None
        """Called for a frame that was never sent because a newer one took its place: identifier, and the
        instant returned by :meth:`send`."""
        self.on_trouble: Callable[[str, Instant], None] | None = None
        """Called with the adapter's events, in words."""
        self.on_unheard: Callable[[Instant], None] | None = None
        """Called when frames before an instant, echoes included, may have been missed."""
        self.unsent_frames = 0
        """Frames that were never sent."""
        self.patience: dict[int, Duration] = {}
        """By identifier, how long a frame may wait before it is given up; others wait for a newer one."""
        self.retry_at: Instant = NEVER
        """Latest instant for the next receive, as frames wait here."""
        self._waiting: SendQueue | None = None
        self._now = clock.now
        port: FramePort | None = getattr(bus, "frame_port", None)
        self._port = MessagePort(bus, clock, stamps) if port is None else port
        self.use(self._port, clock.now, (can.CanError, OSError))

    @property
    def echoes(self) -> EchoBasis:
        """Basis of the echoes of frames sent, and of their instants."""
        return self._port.echoes

    @property
    def cure(self) -> str:
        """The cure for the adapter's present state, if known; empty while it is sound."""
        return self._port.cure

    def tap(self, tap: Tap | FrameTap) -> None:
        """Have ``tap`` see every frame from now on."""
        self.show(tap if isinstance(tap, FrameTap) else CallbackTap(tap))

    def recv(self, until: Instant) -> Received | None:
        """Return the next data frame of another node, or None once ``until`` has come and nothing is waiting.

        Lets time pass. Raises BusDown if the bus is gone.
        """
        while self.fetch(until):
            if not self.last_own:
                return (self.last_id, self.last_data, self.last_at)
        return None

    def request(self, can_id: int, length: int) -> Instant:
        """Queue a remote frame that requests ``length`` bytes; otherwise like :meth:`send`."""
        return self.hand_over(WireFrame(can_id, b"", False, True, length))

    def withdraw(self, can_ids: Container[int]) -> None:
        """Discard the PDOs and SYNCs of ``can_ids`` that wait here: they are never sent."""
        if self._waiting is not None:
            for frame in self._waiting.withdraw(can_ids):
                self._give_up(frame)

    def receiving_failed(self, error: Exception) -> NoReturn:
        """See :class:`servobench.drivers.core.native.Link`, as of the methods below."""
        self._fail("receive from", error)

    def transmitting_failed(self, error: Exception, at: Instant) -> None:
        """The frame is to wait if the bus has only no room."""
        if _code(error) not in NO_ROOM:
            self._fail("send on", error)
        if self._waiting is None:
            self._tell(f"takes no frames: {error}", at)

    def let_wait(self, frame: WireFrame, at: Instant) -> None:
        """Until the bus has room."""
        if self._waiting is None:
            self._waiting, self.retry_at = SendQueue(), Instant(at + RETRY_EVERY)
            self.waits = True
        try:
            older = self._waiting.put(frame, at)
        except can.CanOperationError as error:
            self._fail("send on", error)
        if older is not None:
            self._give_up(older)

    def _give_up(self, frame: WireFrame) -> None:
        self.unsent_frames += 1
        if self.on_unsent is not None:
            self.on_unsent(frame.can_id, frame.handed_at)

    def _is_too_late(self, frame: WireFrame, now: Instant) -> bool:
        patience = self.patience.get(frame.can_id)
        return patience is not None and now - frame.handed_at > patience

    def send_waiting(self, until: Instant) -> Instant:
        """Hand over what the bus takes now; return when to look again, ``until`` at the latest."""
        waiting, now, took = self._waiting, self._now(), False
        while waiting is not None:
            frame = waiting.first()
            if frame is None:
                self._waiting, self.retry_at = None, NEVER
                self.waits = False
                now_so = "takes frames again" if took else "is offered no more frames"
                self._tell(f"{now_so}; {waiting.given_up} were given up meanwhile", now)
                break
            if self._is_too_late(frame, now):
                waiting.drop()
                self._give_up(frame)
                continue
            if not self.offer(frame, now):
                if waiting.stuck(now):
                    self._fail("send on", can.CanOperationError(_STUCK))
                self.retry_at = waiting.retry_at(now)
                return min(until, self.retry_at)
            waiting.went(now)
            took = True
        return until

    def tell_troubles(self) -> None:
        """Those of the port."""
        troubles = self._port.troubles
        for trouble in troubles:
            self._tell(trouble.text, trouble.at)
            if trouble.unheard and self.on_unheard is not None:
                self.on_unheard(trouble.at)
        troubles.clear()

    def _tell(self, text: str, at: Instant) -> None:
        if self.on_trouble is not None:
            self.on_trouble(f"{self.name} {text}", at)

    def _fail(self, action: str, error: Exception) -> NoReturn:
        raise BusDown(
            f"cannot {action} {self.name}",
            str(error),
            self.cure or "check that the interface is up and the cable is in",
        ) from error


def _code(error: Exception) -> int | None:
    """Return the system error number in an exception of python-can or the socket."""
    code = getattr(error, "error_code", None)
    if code is None:
        code = getattr(error, "errno", None)
    return code if isinstance(code, int) else None
