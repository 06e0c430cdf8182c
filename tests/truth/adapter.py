"""An adapter between the loop's port and the simulated bus: stamps late, frames fetched late, or no echoes.

    segment -- end of frame --> held for a drawn time --> stamped, fetched by the loop

Each frame waits for a time of its own, drawn evenly up to ``late_us``. Echoes keep their order, and so do the
frames of others, as in the queues of an adapter; an echo and a frame of another may change places, as they do
on adapters that bring the two from different queues.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Any, Final, NamedTuple

from servobench.drivers.timebase import NEVER, NS_PER_US, Instant
from servobench.drivers.wire.frame_port import UNTOLD, EchoBasis, FramePort, WireFrame
from tests.truth.taps import SYNC_ID

STAMP_TICK_NS: Final = NS_PER_US
"""An adapter's own clock counts microseconds."""


@dataclass(frozen=True, slots=True)
class Adapter:
    """What stamps the frames, and how late."""

    basis: EchoBasis
    """BUS: the end of the frame, as of a hub. HARDWARE: that in whole microseconds, whenever it is fetched.
    KERNEL: the end of the wait. RECEIPT: the instant at which the loop fetches it. NONE: as KERNEL, without
    echoes."""
    late_us: float
    """The longest wait."""
    still_us: tuple[int, int] | None = None
    """The process of a hub stands still from then until then: what was on the bus is fetched at the end of
    that, with its stamps. A hub tells with an echo when its frame was handed over."""


class _Waiting(NamedTuple):
    fetched_at: int
    stamp: int
    frame: WireFrame
    own: bool


class AdapterPort(FramePort):
    """``inner`` as the loop has it through ``adapter``; ``now``: the clock of both."""

    def __init__(self, inner: FramePort, adapter: Adapter, seed: int, now: Callable[[], Instant]) -> None:
        super().__init__()
        self.echoes = adapter.basis
        self.needs_watching = adapter.basis is EchoBasis.RECEIPT
        self._inner = inner
        self._adapter = adapter
        self._draw = Random(f"adapter {seed}")
        self._now = now
        self._queues: dict[bool, deque[_Waiting]] = {True: deque(), False: deque()}
        """Echoes, and the frames of others."""
        self._last_at = {True: 0, False: 0}
        """Of each queue, when its last frame may be fetched."""

    def __getattr__(self, name: str) -> Any:
        """What the bus itself asks of its port."""
        return getattr(self._inner, name)

    def receive(self, until: Instant) -> WireFrame | None:
        inner = self._inner
        while True:
            now = self._now()
            while (frame := inner.receive(now)) is not None:
                self._hold(frame)
            queue = min(self._queues.values(), key=_next_at)
            if _next_at(queue) <= now:
                return self._hand_over(queue.popleft(), now)
            frame = inner.receive(Instant(min(until, _next_at(queue))))
            if frame is not None:
                self._hold(frame)
            elif _next_at(queue) > until:
                return None

    def transmit(self, frame: WireFrame) -> None:
        self._inner.transmit(frame)

    def _hold(self, frame: WireFrame) -> None:
        """A SYNC of the bus's cyclic sender comes as from another node: that sender has a socket of its own,
        and hands nothing over by a link."""
        at = self._inner.came_at
        own = self._inner.came_own and not (frame.can_id == SYNC_ID and frame.handed_at == UNTOLD)
        if own and self.echoes is EchoBasis.NONE:
            return
        fetched_at = at + round(self._draw.random() * self._adapter.late_us * NS_PER_US)
        stamp = fetched_at = max(fetched_at, self._last_at[own])
        if self.echoes is EchoBasis.BUS:
            stamp = at
        elif self.echoes is EchoBasis.HARDWARE:
            stamp = -(-at // STAMP_TICK_NS) * STAMP_TICK_NS
            fetched_at = max(fetched_at, stamp)
        still_us = self._adapter.still_us
        if still_us is not None and still_us[0] * NS_PER_US <= at < still_us[1] * NS_PER_US:
            fetched_at = Instant(still_us[1] * NS_PER_US)
        self._last_at[own] = fetched_at
        self._queues[own].append(_Waiting(fetched_at, stamp, frame, own))

    def _hand_over(self, waiting: _Waiting, now: Instant) -> WireFrame:
        frame = waiting.frame
        if waiting.own and self.echoes is not EchoBasis.BUS:  # no adapter tells when it was handed over
            frame = WireFrame(frame.can_id, frame.data, frame.extended, frame.remote, frame.remote_length)
        self.came_at = now if self.echoes is EchoBasis.RECEIPT else Instant(waiting.stamp)
        self.came_own = waiting.own
        return frame


def _next_at(queue: deque[_Waiting]) -> int:
    return queue[0].fetched_at if queue else NEVER
