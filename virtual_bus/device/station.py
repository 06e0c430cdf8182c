"""Shared services of the parts of one CANopen device: time, NMT state, timers, frames in and out."""

from collections.abc import Callable

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.timebase import NEVER, Instant
from servobench.virtual_bus.device.application import Application
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.frame import Frame

Handler = Callable[[Frame, Instant], None]


class Timer:
    """One deadline of a device; ``due`` is NEVER while it is stopped."""

    __slots__ = ("_timers", "callback", "due")

    def __init__(self, timers: "Timers", callback: Callable[[Instant], None]) -> None:
        self.callback = callback
        self.due: Instant = NEVER
        self._timers = timers

    def start(self, due: Instant) -> None:
        """Run the callback at ``due``; replaces an earlier deadline."""
        timers = self._timers
        was_next = self.due == timers.next
        self.due = due
        if due < timers.next:
            timers.next = due
        elif was_next:
            timers.refresh()

    def stop(self) -> None:
        """Forget the deadline."""
        if self.due != NEVER:
            self.start(NEVER)


class Timers:
    """All timers of a device; a handful, so that the next one is found by looking at each."""

    __slots__ = ("_timers", "next")

    def __init__(self) -> None:
        self._timers: list[Timer] = []
        self.next: Instant = NEVER

    def create(self, callback: Callable[[Instant], None]) -> Timer:
        """A stopped timer."""
        timer = Timer(self, callback)
        self._timers.append(timer)
        return timer

    def refresh(self) -> None:
        """Find the next deadline anew."""
        self.next = NEVER
        for timer in self._timers:
            if timer.due < self.next:
                self.next = timer.due

    def run(self, now: Instant) -> None:
        """Run what is due, the earliest first; a callback may restart its timer only after ``now``."""
        while self.next <= now:
            timer = self._timers[0]
            for candidate in self._timers:
                if candidate.due < timer.due:
                    timer = candidate
            timer.due = NEVER
            self.refresh()
            timer.callback(now)


class Station:
    """The shared part of a device. ``now`` is set by the device at each entry."""

    def __init__(self, node_id: int, dictionary: ObjectDictionary, application: Application) -> None:
        self.node_id = node_id
        self.dictionary = dictionary
        self.application = application
        self.state = NmtState.INITIALISING
        self.now = Instant(0)
        self.timers = Timers()
        self.mute = False
        """Nothing may be sent: the bit rate is being changed."""
        self.out: list[Frame] = []
        """Frames to send, in order, taken over by the device when it returns to its host."""
        self.data_handlers: dict[int, tuple[Handler, ...]] = {}
        """By CAN-ID; several parts may listen to one CAN-ID."""
        self.remote_handlers: dict[int, tuple[Handler, ...]] = {}

    def listen(self, can_id: int, handler: Handler, *, remote: bool = False) -> None:
        """Call ``handler`` for each data (or remote) frame with this CAN-ID."""
        handlers = self.remote_handlers if remote else self.data_handlers
        handlers[can_id] = (*handlers.get(can_id, ()), handler)

    def ignore(self, can_id: int, handler: Handler, *, remote: bool = False) -> None:
        """Undo :meth:`listen`; nothing happens if it was not listening."""
        handlers = self.remote_handlers if remote else self.data_handlers
        left = tuple(other for other in handlers.get(can_id, ()) if other != handler)
        if left:
            handlers[can_id] = left
        else:
            handlers.pop(can_id, None)

    def value(self, index: int, subindex: int = 0) -> int:
        """The integer held by a variable; 0 if the device has no such object."""
        variable = self.dictionary.get(index, subindex)
        return 0 if variable is None else int(variable.read())
