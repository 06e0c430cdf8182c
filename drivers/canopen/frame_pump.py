"""The master's inner loop: hands frames from the link to their handlers, and does housekeeping when due
(core/pump_type.c)."""

from collections.abc import Callable
from functools import partial

from servobench.drivers.canopen.cob_ids import SYNC
from servobench.drivers.core.native import Pump, enter
from servobench.drivers.exchange import Master
from servobench.drivers.timebase import Clock, Instant
from servobench.drivers.wire.link import BusLink

Handler = Callable[[bytes, Instant], None]
"""Takes the data of a frame and its instant."""
EchoHandler = Callable[[bytes, Instant, Instant], None]
"""Takes the same, and the instant of the hand-over; UNTOLD if the bus does not report it."""


def one_after_another(first: Handler, second: Handler) -> Handler:
    """Combine two handlers into one."""

    def both(data: bytes, at: Instant) -> None:
        first(data, at)
        second(data, at)

    return both


class FramePump(Master):
    """Lets time pass on ``link`` and dispatches received frames.

    ``others(can_id, data, at)`` gets the frames that no entry of ``handlers`` takes; ``keep_house(now)``
    is called when ``housekeeping_at`` has come, and sets it anew. An echo goes to its entry of
    ``echo_handlers``, by identifier, and nowhere else.
    """

    def __init__(
        self,
        link: BusLink,
        clock: Clock,
        others: Callable[[int, bytes, Instant], None],
        keep_house: Callable[[Instant], None],
    ) -> None:
        super().__init__()
        self.handlers: dict[int, Handler] = {}
        self.echo_handlers: dict[int, EchoHandler] = {SYNC: self._on_sync_echo}
        """Handlers of our own frames once they were on the bus, by identifier."""
        self.unsent_handlers: dict[int, Callable[[Instant], None]] = {SYNC: self._on_sync_unsent}
        """Handlers of our own frames that were never sent, by identifier: the instant of the hand-over."""
        self._link = link
        self._others = others
        self._pump = Pump(
            link, self.handlers, self.echo_handlers, others, keep_house, clock.now, clock.sleep_until
        )
        self._pump_all, self._pump_one, self._rest = self._pump.pump, self._pump.pump_one, self._pump.rest
        self._send = link.send
        link.on_unsent = self._on_unsent
        link.on_unheard = self._on_unheard
        self._listeners: dict[int, Handler] = {}
        self._overhearers: dict[int, Handler] = {}

    @property
    def housekeeping_at(self) -> Instant:
        """When ``keep_house`` is called next."""
        return self._pump.housekeeping_at

    @housekeeping_at.setter
    def housekeeping_at(self, at: Instant) -> None:
        self._pump.housekeeping_at = at

    @property
    def attend_at(self) -> Instant:
        """Latest instant at which the pump must run: for housekeeping, or for frames that wait for room."""
        return min(self.housekeeping_at, self._link.retry_at)

    def listen(self, can_id: int, handler: Handler | None) -> None:
        """Have ``handler`` take the frames of an identifier; None restores ``others``."""
        if handler is None:
            self._listeners.pop(can_id, None)
        else:
            self._listeners[can_id] = handler
        self._join(can_id)

    def overhear(self, can_id: int, handler: Handler) -> None:
        """Have ``handler`` see them as well, after their present or later handler."""
        self._overhearers[can_id] = handler
        self._join(can_id)

    def _join(self, can_id: int) -> None:
        first, second = self._listeners.get(can_id), self._overhearers.get(can_id)
        if second is not None:
            first = one_after_another(first or partial(self._others, can_id), second)
        if first is None:
            self.handlers.pop(can_id, None)
        else:
            enter(self.handlers, can_id, first)

    def pump(self, until: Instant) -> None:
        """Handle frames, send what falls due, and return once ``until`` has come; at once if it has passed.

        Frames already waiting are handled in either case.
        """
        self._pump_all(until)

    def pump_one(self, until: Instant) -> bool:
        """Handle the next frame and return True; False once ``until`` has come without one."""
        return self._pump_one(until)

    def rest(self, until: Instant) -> None:
        """Let time pass like :meth:`pump`, but leave frames in the bus's queue until ``until``, or until
        housekeeping is due: one wake-up instead of one per frame. The bus stamps them, so nothing is lost; on
        a bus that needs watching this is :meth:`pump`."""
        self._rest(until)

    def _on_sync_echo(self, _data: bytes, at: Instant, handed_at: Instant) -> None:
        if self.on_sync_echo is not None:
            self.on_sync_echo(at, handed_at)

    def _on_unsent(self, can_id: int, handed_at: Instant) -> None:
        handler = self.unsent_handlers.get(can_id)
        if handler is not None:
            handler(handed_at)

    def _on_sync_unsent(self, handed_at: Instant) -> None:
        if self.on_sync_unsent is not None:
            self.on_sync_unsent(handed_at)

    def _on_unheard(self, until: Instant) -> None:
        if self.on_unheard is not None:
            self.on_unheard(until)

    def withdraw(self) -> None:
        self._link.withdraw(self.unsent_handlers)

    def send_sync(self) -> Instant:
        """Send a SYNC without counter (CiA 301 7.2.5); returns the instant at which the bus was given it."""
        self.sync_count += 1
        at = self._send(SYNC, b"")
        self.sync_handed_at[0] = at
        return at
