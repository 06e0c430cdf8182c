"""Signs of the master's life for the nodes: its heartbeat, and the requests of node guarding."""

from typing import Final

from servobench.drivers.canopen.cob_ids import ERROR_CONTROL
from servobench.drivers.timebase import NEVER, Clock, Duration, Instant
from servobench.drivers.wire.link import BusLink

_OPERATIONAL: Final = b"\x05"
_ANSWER_BYTES: Final = 1
"""A remote frame has the length of the answer that it requests (CiA 301 7.2.8.3.2.1)."""


class _Sign:
    """One sign. ``sent_at``: None before the first."""

    __slots__ = ("can_id", "due", "period_ns", "sent_at")

    def __init__(self, can_id: int, period_ns: Duration, now: Instant) -> None:
        self.can_id = can_id
        self.period_ns = period_ns
        self.due = now
        self.sent_at: Instant | None = None


class LifeSigns:
    """The life signs of one master, sent by its pump, so that a master that stops pumping falls silent."""

    def __init__(self, link: BusLink, clock: Clock, node_id: int) -> None:
        """``node_id``: the master's own."""
        self._link = link
        self._clock = clock
        self._heartbeat_id = ERROR_CONTROL + node_id
        self._signs: dict[int, _Sign] = {}
        self._withheld = False
        self.longest_gap_ns = Duration(0)
        """The longest interval between two signs of one kind since this was set to 0."""

    @property
    def heartbeat(self) -> bool:
        """True if the master's heartbeat is being sent."""
        return self._heartbeat_id in self._signs

    @property
    def due(self) -> Instant:
        """When the next sign is due; NEVER without any."""
        if self._withheld:
            return NEVER
        return min((sign.due for sign in self._signs.values()), default=NEVER)

    def beat(self, period_ns: Duration) -> None:
        """Send the heartbeat, state OPERATIONAL, now and then every ``period_ns``; 0 ends it."""
        self._set(self._heartbeat_id, period_ns)

    def guard(self, node_id: int, period_ns: Duration) -> None:
        """Request a node's NMT state by remote frame, now and then every ``period_ns``; 0 ends it."""
        self._set(ERROR_CONTROL + node_id, period_ns)

    def end(self) -> None:
        """Fall silent."""
        self._signs.clear()

    def withhold(self) -> None:
        """Send none until :meth:`resume`."""
        self._withheld = True

    def resume(self) -> None:
        """Send each at once, and go on."""
        self._withheld = False
        for sign in self._signs.values():
            sign.due, sign.sent_at = self._clock.now(), None

    def keep(self, now: Instant) -> None:
        """Send the signs due at ``now``."""
        if self._withheld:
            return
        for sign in self._signs.values():
            if now < sign.due:
                continue
            # Not ``now``, which is the stamp of a frame that may have waited for a host that stood still.
            at = self._clock.now()
            if sign.can_id == self._heartbeat_id:
                self._link.send(sign.can_id, _OPERATIONAL)
            else:
                self._link.request(sign.can_id, _ANSWER_BYTES)
            if sign.sent_at is not None:
                self.longest_gap_ns = max(self.longest_gap_ns, Duration(at - sign.sent_at))
            sign.sent_at = at
            # Missed signs are not made up for, and the grid is not shifted by a late one.
            missed = (now - sign.due) // sign.period_ns
            sign.due = Instant(sign.due + (missed + 1) * sign.period_ns)

    def _set(self, can_id: int, period_ns: Duration) -> None:
        if period_ns:
            self._signs[can_id] = _Sign(can_id, period_ns, self._clock.now())
        else:
            self._signs.pop(can_id, None)
