"""Periodic sending in simulated time, in the place of python-can's thread."""

from collections.abc import Callable, Sequence

import can
from can.broadcastmanager import (
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)

from drivers.timebase import Instant, instant_after
from virtual_bus.timeline import Event, Timeline


class TimelineCyclicTask(LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC):
    """Sends its messages in turn, one each period, the first at ``start``.

    The due times are start + k * period: they do not drift. A message that the transmit
    queue refuses is counted in ``refused`` and not sent later.
    """

    def __init__(
        self,
        timeline: Timeline,
        send: Callable[[can.Message], None],
        messages: Sequence[can.Message] | can.Message,
        period_s: float,
        limit_s: float | None,
        modify: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(messages, period_s, limit_s)
        self._timeline = timeline
        self._send = send
        self._modify = modify
        self._event: Event | None = None
        self._started_at = Instant(0)
        self._turn = 0
        self.refused = 0

    def start(self) -> None:
        """Send the first message now; no effect while running."""
        if self._event is None:
            self._started_at = self._timeline.now
            self._turn = 0
            self._event = self._timeline.call_at(self._started_at, self._fire)

    def stop(self) -> None:
        """Send no more; no effect if stopped."""
        if self._event is not None:
            self._event.cancel()
            self._event = None

    def _fire(self, _now: Instant) -> None:
        message = self.messages[self._turn % len(self.messages)]
        if self._modify is not None:
            self._modify(message)
        try:
            self._send(message)
        except can.CanOperationError:
            self.refused += 1
        self._turn += 1
        due = Instant(self._started_at + self._turn * self.period_ns)
        if self.duration is not None and due >= instant_after(self._started_at, self.duration):
            self._event = None
        else:
            self._event = self._timeline.call_at(due, self._fire)
