"""A CANopen device without I/O: CiA 301 around an application.

    host  -- receive(frame), wake(now) -->  CanopenDevice  -- advance, on_sync, hooks -->  Application
          <-- frames, wake_at -----------

The device is put together from parts that share a
:class:`servobench.virtual_bus.device.station.Station`; each part reads
its parameters from the dictionary and hooks its checks into it. An object that the dictionary has not
got switches its feature off.
"""

from collections.abc import Callable, Sequence
from typing import Final

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NODE_ID_MAX, UNCONFIGURED, NmtState
from servobench.drivers.canopen.objects301 import FIRST_OBJECT, Cia301
from servobench.drivers.timebase import NEVER, NS_PER_MS, Instant
from servobench.drivers.vendors.families import stamp_for
from servobench.virtual_bus.core.native import CyclicDevice, DeviceClock
from servobench.virtual_bus.device.communication_objects import add_communication_objects
from servobench.virtual_bus.device.device_options import DeviceOptions
from servobench.virtual_bus.device.emergency import EmergencyProducer
from servobench.virtual_bus.device.heartbeat import HeartbeatConsumers, HeartbeatProducer, NodeGuarding
from servobench.virtual_bus.device.lss_slave import LssSlave
from servobench.virtual_bus.device.nmt import NmtSlave
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.device.parameter_storage import MemoryStore, ParameterStorage, ParameterStore
from servobench.virtual_bus.device.pdo_engine import PdoEngine
from servobench.virtual_bus.device.sdo_server import SdoServer
from servobench.virtual_bus.device.station import Application, CommunicationLoss, Handler, Station, task_of
from servobench.virtual_bus.device.sync_consumer import SyncConsumer
from servobench.virtual_bus.frame import Frame

RECOVERED_FROM_BUS_OFF: Final = 0x8140
"""EMCY (CiA 301, table 26)."""

_NOTHING: Final[tuple[Frame, ...]] = ()
_COMMUNICATION_PROFILE: Final = (FIRST_OBJECT, 0x1FFF)
_APPLICATION: Final = (0x2000, 0xFFFF)


class CanopenDevice:
    """One device; implements :class:`servobench.virtual_bus.frame.Device` and the application's
    DeviceServices."""

    def __init__(
        self,
        node_id: int,
        application: Application,
        options: DeviceOptions | None = None,
        store: ParameterStore | None = None,
        vendor: Callable[[ObjectDictionary], None] | None = None,
    ) -> None:
        """``node_id``: 1..127, or 255 for a device that waits for LSS. The application's objects are
        added here. ``store``: keeps what 1010h and LSS store. ``vendor``: makes the finished dictionary
        another device's, before the parts of the device hook into it."""
        assert 1 <= node_id <= NODE_ID_MAX or node_id == UNCONFIGURED, f"node-ID {node_id}"
        options = options or DeviceOptions()
        self._station = station = Station(node_id, ObjectDictionary(), application)
        self._application = application
        tasks = options.tasks
        station.receiving = task_of(tasks.rpdo_ns, tasks.rpdo_phase_ns, tasks.dead_ns)
        station.sending = task_of(tasks.tpdo_ns, tasks.tpdo_phase_ns)
        self._cycle = station.cycle
        stamp = options.stamp
        self.clock = clock = DeviceClock(
            station.cycle,
            options.clock_offset_ns,
            options.clock_drift_ppb,
            stamp.unit_ns,
            stamp.resolution_ns,
            stamp.bits,
            stamp.late_ns,
            stamp.runs,
            application.tick_after if stamp.latched == "tick" else None,
        )
        clock.at_arrival = stamp.latched == "arrival"
        add_communication_objects(station.dictionary, options)
        application.attach(self)
        station.cycle.drive = application.cycle
        if vendor is not None:
            vendor(station.dictionary)
        self._emergency = EmergencyProducer(station)
        self._nmt = NmtSlave(station, self._reset_node, self._reset_communication)
        self._pdos = PdoEngine(station, self._emergency)
        self._sync = SyncConsumer(station, self._emergency, clock, options.sync, options.tasks.locked)
        store = store or MemoryStore()
        self._storage = ParameterStorage(station.dictionary, store)
        self._lss = LssSlave(station, store, self._take_node_id)
        self._sdo = SdoServer(station)
        self._heartbeat = HeartbeatProducer(station)
        self._consumers = HeartbeatConsumers(station, self._emergency, self._nmt)
        self._guarding = NodeGuarding(station, self._emergency, self._nmt, self._heartbeat)
        for part in (self._emergency, self._sdo, self._pdos, self._heartbeat):
            self._nmt.add_listener(part.on_state)
        self._boot_after_reset_ns = options.boot_after_reset_ms * NS_PER_MS
        self._slow_boot: Callable[[], int] = lambda: 0
        self._boot_timer = station.timer(self._boot_up)
        makers = stamp_for(station.value(Cia301.IDENTITY, 1), station.value(Cia301.IDENTITY, 2), "")
        for index in {Cia301.HIGH_RESOLUTION_TIME_STAMP, makers.index}:
            station.dictionary.hook(index, provider=clock.told, on_write=clock.write)

    @property
    def node_id(self) -> int:
        """1..127; 255 while the device has none."""
        return self._station.node_id

    @property
    def state(self) -> NmtState:
        """The present NMT state."""
        return self._station.state

    @property
    def now(self) -> Instant:
        """The instant of the last entry."""
        return self._station.now

    @property
    def cycle(self) -> CyclicDevice:
        """What a segment hands its frames to."""
        return self._cycle

    @property
    def application(self) -> Application:
        """The device's application."""
        return self._application

    @property
    def dictionary(self) -> ObjectDictionary:
        """All objects."""
        return self._station.dictionary

    def raise_error(self, code: int, register: ErrorRegister, information: bytes = b"") -> None:
        """See :class:`servobench.virtual_bus.device.station.DeviceServices`."""
        self._emergency.raise_error(code, register, information)

    def repeat_error(self, code: int, register: ErrorRegister) -> None:
        """See :class:`servobench.virtual_bus.device.station.DeviceServices`."""
        self._emergency.repeat_error(code, register)

    def clear_error(self, code: int) -> None:
        """See :class:`servobench.virtual_bus.device.station.DeviceServices`."""
        self._emergency.clear_error(code)

    def follow_bit_rate(self, set_bit_rate: Callable[[int], None]) -> None:
        """Have LSS set the bit rate, bit/s, of the controller that the device is behind."""
        self._lss.follow_bit_rate(set_bit_rate)

    def follow_boot_time(self, boot_time: Callable[[], int]) -> None:
        """Boot for at least as long as ``boot_time`` says, ns; it is asked once a boot, power-on included."""
        self._slow_boot = boot_time

    def answer_scan_in_configuration(self) -> None:
        """From now on every frame of an LSS fast scan is answered in the configuration state too."""
        self._lss.scan_answered_in_configuration = True

    @property
    def heard(self) -> dict[int, tuple[Handler, ...]]:
        """The identifiers of the data frames that it listens to, as they are at the time."""
        return self._station.data_handlers

    @property
    def due_at(self) -> Instant:
        """The earliest timer of the device or wish of its application; now, if frames are waiting; NEVER."""
        return self._cycle.due_at

    @property
    def wake_at(self) -> Instant | None:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        due = self.due_at
        return None if due == NEVER else due

    def start(self, now: Instant) -> Sequence[Frame]:
        """Power on, for the first time or again: boot-up, PRE-OPERATIONAL."""
        self._cycle.now = now
        for task in (self._station.receiving, self._station.sending):
            if task is not None:
                task.begin(now)
        self._cycle.forget_frames()
        self._storage.power_on()
        self._lss.power_on()
        self._enter_reset(now)
        self._restart_communication(now, 0)
        return self._cycle.take_frames()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """A frame ended on the bus at ``now``; one that nobody listens to costs a dictionary look-up."""
        station = self._station
        handlers = (station.remote_handlers if frame.remote else station.data_handlers).get(frame.can_id)
        if handlers is None or frame.extended:
            return _NOTHING
        return self._cycle.hear(handlers, frame, now)

    def wake(self, now: Instant) -> Sequence[Frame]:
        """Bring the application to ``now``, then run the timers that are due."""
        return self._cycle.wake(now)

    def bus_off(self, now: Instant) -> None:
        """The host's controller went bus-off: 1029h acts; nothing can be sent (CiA 301, 7.5.2.32)."""
        self._cycle.advance(now)
        self._application.on_communication_loss(CommunicationLoss.BUS_OFF, 0, now)
        self._nmt.on_communication_error(now)
        self._cycle.forget_frames()

    def bus_recovered(self, now: Instant) -> Sequence[Frame]:
        """The controller is back on the bus: EMCY 8140h tells, and is over at once."""
        self._cycle.advance(now)
        self._emergency.raise_error(RECOVERED_FROM_BUS_OFF, ErrorRegister.COMMUNICATION)
        self._emergency.clear_error(RECOVERED_FROM_BUS_OFF)
        return self._cycle.take_frames()

    def _reset_node(self, now: Instant) -> None:
        self._enter_reset(now)
        self._restart_communication(now, self._boot_after_reset_ns)

    def _enter_reset(self, now: Instant) -> None:
        self._nmt.enter(NmtState.INITIALISING, now)
        self.clock.start(now)
        self._station.dictionary.restore(*_APPLICATION, self._lss.pending_node_id)
        self._emergency.reset_node()
        self._application.on_reset(now)

    def _reset_communication(self, now: Instant) -> None:
        self._nmt.enter(NmtState.INITIALISING, now)
        self._emergency.reset_communication()
        self._restart_communication(now, self._boot_after_reset_ns)

    def _take_node_id(self, now: Instant) -> None:
        """By LSS."""
        self._restart_communication(now, self._boot_after_reset_ns)

    def _restart_communication(self, now: Instant, takes_ns: int) -> None:
        """``takes_ns``: until the boot-up message, if nothing makes it slower."""
        self._station.node_id = self._lss.pending_node_id
        self._station.dictionary.restore(*_COMMUNICATION_PROFILE, self.node_id)
        self._emergency.update_register()
        for part in (self._sdo, self._pdos, self._sync, self._consumers, self._guarding):
            part.reset_communication()
        self._boot_timer.stop()
        takes_ns = max(takes_ns, self._slow_boot())
        self._cycle.booting = self.node_id != UNCONFIGURED and takes_ns > 0
        if self._cycle.booting:
            self._boot_timer.start(Instant(now + takes_ns))
        else:
            self._boot_up(now)

    def _boot_up(self, now: Instant) -> None:
        self._cycle.booting = False
        self._heartbeat.reset_communication()
        if self.node_id != UNCONFIGURED:
            self._nmt.boot_up(now)
