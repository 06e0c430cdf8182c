"""Shared services of the parts of one CANopen device: time, NMT state, timers, frames in and out."""

from collections.abc import Callable
from typing import Final

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.core.native import CyclicDevice, CyclicRpdo, SyncTaker, Timer, enter
from servobench.virtual_bus.device.application import Application
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.device.pdo_task import PdoTask
from servobench.virtual_bus.frame import Frame

Handler = Callable[[Frame, Instant], None] | CyclicRpdo | SyncTaker


class Station:
    """The shared part of a device; what each cycle asks of it is in ``cycle`` (core/device.c)."""

    def __init__(self, node_id: int, dictionary: ObjectDictionary, application: Application) -> None:
        self.node_id = node_id
        self.dictionary = dictionary
        self.application = application
        self._state = NmtState.INITIALISING
        self.cycle: Final = CyclicDevice(application)
        self.receiving: PdoTask | None = None
        """The task that takes RPDOs in; None: at once."""
        self.sending: PdoTask | None = None
        """The task that acts on SYNCs and sends TPDOs; None: at once."""
        self.data_handlers: dict[int, tuple[Handler, ...]] = {}
        """By CAN-ID; several parts may listen to one CAN-ID."""
        self.remote_handlers: dict[int, tuple[Handler, ...]] = {}

    @property
    def state(self) -> NmtState:
        """The present NMT state."""
        return self._state

    @state.setter
    def state(self, state: NmtState) -> None:
        self._state = state
        self.cycle.operational = state is NmtState.OPERATIONAL
        self.cycle.takes_syncs = state in (NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL)

    @property
    def now(self) -> Instant:
        """The instant of the last entry."""
        return self.cycle.now

    def timer(self, callback: Callable[[Instant], None]) -> Timer:
        """A stopped timer."""
        return Timer(self.cycle, callback)

    def send(self, frame: Frame) -> None:
        """Queue a frame, which the device gives its host when it returns."""
        self.cycle.send(frame)

    def listen(self, can_id: int, handler: Handler, *, remote: bool = False) -> None:
        """Call ``handler`` for each data (or remote) frame with this CAN-ID."""
        handlers = self.remote_handlers if remote else self.data_handlers
        enter(handlers, can_id, (*handlers.get(can_id, ()), handler))

    def ignore(self, can_id: int, handler: Handler, *, remote: bool = False) -> None:
        """Undo :meth:`listen`; nothing happens if it was not listening."""
        handlers = self.remote_handlers if remote else self.data_handlers
        left = tuple(other for other in handlers.get(can_id, ()) if other != handler)
        if left:
            enter(handlers, can_id, left)
        else:
            handlers.pop(can_id, None)

    def value(self, index: int, subindex: int = 0) -> int:
        """The integer held by a variable; 0 if the device has no such object."""
        variable = self.dictionary.get(index, subindex)
        return 0 if variable is None else int(variable.read())
