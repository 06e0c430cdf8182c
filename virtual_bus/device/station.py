"""Shared services of the parts of one CANopen device: time, NMT state, timers, frames in and out.

A task of a device's firmware that looks at its PDOs once a period, and not when a frame ends.

frame ends     |        |  |                 |
ticks        |     |     |     |     |     |     |      from power-on, or from the last SYNC
acted on           |     ||                |            a dead time behind the tick

Between the CANopen device engine and what the device does: the interface of an application.

The engine (:mod:`servobench.virtual_bus.device.canopen_device`) owns communication, CiA 301. The application
owns the device's purpose, for a drive CiA 402. It fills its part of the object dictionary in
:meth:`Application.attach`, keeps the values of its variables up to date in
:meth:`Application.advance`, and acts on what the master writes through the ``check`` and
``on_write`` hooks of its variables (:class:`servobench.virtual_bus.device.object_dictionary.Variable`).

Order of calls, all on one thread, ``now`` never running backwards:

    attach(services)                     once, before power-on
    on_reset(now)                        power-on, reset application; values are at power-on again
    advance(now)                         before whatever else happens at ``now``
    [check, store, on_write] of variables, on_sync, on_nmt, on_communication_loss ...

At a SYNC: ``advance``; the synchronous TPDOs are sampled; the synchronous RPDOs that were
waiting are applied; ``on_sync``. So a TPDO shows the device just before the new set-points act.
"""

from collections.abc import Callable
from enum import Enum
from typing import Final, Protocol

from mypy_extensions import mypyc_attr

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.timebase import NEVER, Instant
from servobench.virtual_bus.core.native import CyclicDevice, CyclicDrive, CyclicRpdo, SyncTaker, Timer, enter
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.frame import Frame


class PdoTask:
    """Tells when what has come is acted on."""

    def __init__(self, period_ns: int, phase_ns: int, dead_ns: int = 0) -> None:
        """``period_ns``: 0: it acts at once, but for ``dead_ns``."""
        self._period_ns, self._phase_ns, self._dead_ns = period_ns, phase_ns, dead_ns
        self._first_at = phase_ns

    def begin(self, at: Instant) -> None:
        """Power-on, or a SYNC: ticks count from there."""
        self._first_at = at + self._phase_ns

    def due(self, now: Instant) -> Instant:
        """The dead time after the next tick, at ``now`` or later."""
        at = int(now)
        if self._period_ns:
            ticks = -((self._first_at - at) // self._period_ns)
            at = self._first_at + ticks * self._period_ns
        return Instant(at + self._dead_ns)


def task_of(period_ns: int, phase_ns: int, dead_ns: int = 0) -> PdoTask | None:
    """Return that task; None if it would act at once."""
    return PdoTask(period_ns, phase_ns, dead_ns) if period_ns or dead_ns else None


class CommunicationLoss(Enum):
    """Reason why the device is no longer supervised by its master."""

    HEARTBEAT = "heartbeat"
    """A consumer heartbeat time of 1016h ran out."""
    LIFE_GUARDING = "life guarding"
    """Guard time (100Ch) x life time factor (100Dh) ran out."""
    RPDO_DEADLINE = "RPDO deadline"
    """The event timer of an RPDO ran out (CiA 301, 7.5.2.35); the NMT state is not touched."""
    BUS_OFF = "bus off"


class DeviceServices(Protocol):
    """The engine's services to its application.

    ``raise_error`` and ``clear_error`` belong into the engine's calls to the application; from elsewhere,
    let the device ``wake`` at the present instant first and again afterwards. So it is with a value that
    is to be the event of a TPDO: the engine sees it at the end of its call.
    """

    @property
    def node_id(self) -> int:
        """1..127."""
        ...

    @property
    def state(self) -> NmtState:
        """The present NMT state."""
        ...

    @property
    def now(self) -> Instant:
        """The instant of the call that the engine is in."""
        ...

    @property
    def dictionary(self) -> ObjectDictionary:
        """The device's dictionary; the application adds its objects in ``attach``."""
        ...

    def raise_error(self, code: int, register: ErrorRegister, information: bytes = b"") -> None:
        """Send an EMCY, enter it in 1003h and set ``register`` in 1001h until ``clear_error(code)``.

        ``code``: EMCY error code. ``information``: up to 5 bytes, manufacturer-specific. Raising a code
        that is already active does nothing.
        """
        ...

    def repeat_error(self, code: int, register: ErrorRegister) -> None:
        """Raise an error like ``raise_error``, and send an EMCY again if the code is active already."""
        ...

    def clear_error(self, code: int) -> None:
        """The cause of ``code`` is gone: 1001h follows, and EMCY 0000h is sent (CiA 301, 7.2.7.1).

        Nothing happens if ``code`` was not active.
        """
        ...


@mypyc_attr(allow_interpreted_subclasses=True)
class Application:
    """A device's application; the base class is a device that does nothing. Override what is needed."""

    wake_at: Instant = NEVER
    """When the application wants to be advanced without being asked; NEVER: not at all."""
    cycle: CyclicDrive | None = None
    """Advanced, and asked when it wants to be, in the place of the application, which hears of SYNCs only if
    it asks for them."""

    def attach(self, services: DeviceServices) -> None:
        """Add objects to ``services.dictionary`` and keep ``services``."""

    def on_reset(self, now: Instant) -> None:
        """Power-on or NMT reset application: the dictionary holds its power-on values again.

        The physical world behind the application is not reset: a shaft that turns goes on turning.
        """

    def advance(self, now: Instant) -> None:
        """Bring the world behind the device to ``now``, and the variables up to date.

        On the cyclic path, so it has to be cheap, above all when it is called twice for one ``now``.
        """

    def tick_after(self, now: Instant) -> Instant:
        """The next tick of its inner loops at or after ``now``; ``now`` where it has none."""
        return now

    def on_sync(self, counter: int, now: Instant) -> None:
        """A SYNC in PRE-OPERATIONAL or OPERATIONAL; ``counter``: 1..240, or 0 without a counter."""

    def on_nmt(self, state: NmtState, now: Instant) -> None:
        """The NMT state became ``state``; INITIALISING comes with both resets, before anything is reset."""

    def on_communication_loss(self, cause: CommunicationLoss, node_id: int, now: Instant) -> None:
        """Supervision failed, ``node_id`` the lost node (0 if none in particular).

        Called before the error behaviour of 1029h acts, for CiA 402 object 6007h.
        """


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
